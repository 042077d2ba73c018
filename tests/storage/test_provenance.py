"""Provenance: the record of what made a result."""

import platform
import subprocess
from pathlib import Path

import pytest

from jaxsafe.storage import provenance


def test_a_commit_is_that_of_the_code_and_says_when_the_code_is_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def git(*words: str) -> str:
        command = [
            "git",
            "-C",
            str(tmp_path),
            "-c",
            "user.name=test",
            "-c",
            "user.email=test@example.org",
            *words,
        ]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    package = tmp_path / "package"
    for file in (
        package / "types.py",
        package / "code.py",
        package / "policies" / "one.npz",
        tmp_path / "configs" / "task.yaml",
        tmp_path / "page.md",
    ):
        file.parent.mkdir(exist_ok=True, parents=True)
        file.write_text("first")
    monkeypatch.setattr(provenance, "__file__", str(package / "storage" / "provenance.py"))
    assert provenance.commit() is None
    git("init", "-q")
    git("add", "-A")
    git("commit", "-qm", "all of it")
    head = git("rev-parse", "HEAD")[:12]
    assert provenance.commit() == head
    for result in (
        tmp_path / "page.md",
        package / "policies" / "one.npz",
        package / "policies" / "another.npz",
    ):
        result.write_text("another")
    assert provenance.commit() == head
    for code in (package / "code.py", tmp_path / "configs" / "task.yaml", package / "new.py"):
        code.write_text("another")
        assert provenance.commit() == f"{head} with changes"
        git("stash", "-q", "-u")
        assert provenance.commit() == head


def test_a_package_inside_another_repository_has_no_commit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / ".venv" / "package"
    package.mkdir(parents=True)
    (package / "types.py").write_text("installed")
    (tmp_path / "mine.py").write_text("mine")
    mine = ["git", "-C", str(tmp_path), "-c", "user.name=test", "-c", "user.email=test@example.org"]
    for words in (["init", "-q"], ["add", "mine.py"], ["commit", "-qm", "mine"]):
        subprocess.run([*mine, *words], check=True)
    monkeypatch.setattr(provenance, "__file__", str(package / "storage" / "provenance.py"))
    assert provenance.commit() is None


@pytest.mark.parametrize(
    ("text", "name"),
    [
        (
            (
                "processor\t: 0\ncpu family\t: 25\nmodel\t\t: 17\nmodel name\t: AMD EPYC\n\nmodel"
                " name: other\n"
            ),
            "AMD EPYC, family 25, model 17",
        ),
        ("model name\t: Some: Core\n", "Some: Core"),
        ("BogoMIPS\t: 50.00\n", "that of the platform"),
        (None, "that of the platform"),
    ],
)
def test_a_processor_is_named_with_what_tells_kinds_of_one_name_apart(
    text: str | None, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(platform, "processor", lambda: "that of the platform")
    file = tmp_path / "cpuinfo"
    if text is not None:
        file.write_text(text)
    assert provenance.processor(file) == name
