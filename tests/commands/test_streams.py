import errno
import io
import os
import subprocess
import sys
import threading
from pathlib import Path

import jax
import pytest
from default_cases import thorough
from tiny_run import TINY

from jaxsafe import make
from jaxsafe.commands import cli
from jaxsafe.commands import train as train
from jaxsafe.commands.streams import LastingStream
from jaxsafe.config import load
from jaxsafe.devices.compilation_cache import enable_compilation_cache

ROOT = Path(__file__).parents[2]


def shell(command: str, place: Path) -> subprocess.CompletedProcess[str]:
    """Run a line of the shell. In it `jaxsafe` runs our commands by this Python."""
    command = (
        f"jaxsafe() {{ module=$1; shift; '{sys.executable}' -m jaxsafe.$module \"$@\";"
        f" }}; {command}"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUTF8": "0"}
    return subprocess.run(
        ["bash", "-c", command],
        cwd=place,
        env=environment,
        capture_output=True,
        check=False,
        encoding="utf-8",
        errors="replace",
    )


@pytest.mark.thorough
@pytest.mark.parametrize(
    "environment",
    ["PYTHONIOENCODING=cp1252", thorough("PYTHONIOENCODING=ascii"), thorough("LC_ALL=POSIX")],
)
def test_what_an_encoding_lacks_is_replaced(environment: str, tmp_path: Path) -> None:
    told = shell(
        f"export {environment}; jaxsafe plot.safe_set points=1 2>&1; jaxsafe train --help", tmp_path
    )
    assert told.stdout.startswith("error: points: expected a whole number ")
    assert "usage: jaxsafe train" in told.stdout
    assert told.stderr == ""


@pytest.mark.thorough
def test_an_environment_that_is_printed_can_be_read_again_whatever_the_encoding(
    tmp_path: Path,
) -> None:
    text = (
        (ROOT / "configs" / "custom_env.yaml")
        .read_text(encoding="utf-8")
        .replace("docking_region", "Ringfläche_日本")
    )
    (tmp_path / "mine.yaml").write_text(text, encoding="utf-8")
    ran = shell("export PYTHONIOENCODING=cp1252; jaxsafe config mine.yaml > copy.yaml", tmp_path)
    assert (ran.returncode, ran.stderr) == (0, "")
    assert load(tmp_path / "copy.yaml") == make(tmp_path / "mine.yaml")


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("command", "code", "told"),
    [
        ("jaxsafe config docking2d | head -1; exit ${PIPESTATUS[0]}", 0, ""),
        (f"'{sys.executable}' -m jaxsafe | true; exit ${{PIPESTATUS[0]}}", 0, ""),
        thorough("jaxsafe train help | true; exit ${PIPESTATUS[0]}", 0, ""),
        (
            "jaxsafe config docking2d > /dev/full",
            2,
            "error: standard output: No space left on device\n",
        ),
        ("jaxsafe config docking2d >&-", 0, ""),
        thorough("jaxsafe config docking2d 2>&- > file", 0, ""),
        thorough("jaxsafe config nowhere 2>&-", 2, ""),
        thorough("jaxsafe config nowhere 2> /dev/full", 2, ""),
        ("jaxsafe config nowhere | true; exit ${PIPESTATUS[0]}", 2, "error: env: unknown task"),
    ],
)
def test_a_reader_that_goes_away_and_a_full_disk_end_no_command_in_a_traceback(
    command: str, code: int, told: str, tmp_path: Path
) -> None:
    ran = shell(command, tmp_path)
    assert (ran.returncode, ran.stderr[: len(told)], ran.stderr.count("\n")) == (
        code,
        told,
        int(bool(told)),
    )


def test_control_characters_of_a_stranger_do_not_reach_the_terminal() -> None:
    kept = io.StringIO()
    LastingStream(kept).write("a\x1b]0;title\x07b\rc\x9b2Jd\te\n")
    assert kept.getvalue() == r"a\x1b]0;title\x07b\x0dc\x9b2Jd" + "\te\n"
    LastingStream(kept, allowed="\r").write("\r10 %")
    assert kept.getvalue().endswith("\r10 %")


def test_a_stream_that_failed_leads_nowhere_and_says_why() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "w", encoding="utf-8") as stream:
        lasting = LastingStream(stream)
        for _ in range(2):
            lasting.write("x" * 100_000)
            lasting.flush()
        assert isinstance(lasting.error, BrokenPipeError)
        assert lasting.error.errno == errno.EPIPE
        assert lasting.encoding == "utf-8"
        os.write(writer, b"what a library prints")


@pytest.mark.thorough
def test_a_training_in_any_thread_ends_well_though_nobody_reads_its_output(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "w", encoding="ascii") as stream:
        monkeypatch.setattr(sys, "stdout", stream)
        monkeypatch.setattr(sys, "stderr", stream)
        monkeypatch.setattr(sys, "argv", ["train", *TINY, f"out={tmp_path / 'run'}"])
        codes: list[object] = []

        def run() -> None:
            with pytest.raises(SystemExit) as left:
                cli.run(train.main, train.Options)
            codes.append(left.value.code)

        thread = threading.Thread(target=run)
        thread.start()
        thread.join()
    assert codes == [0]
    assert (tmp_path / "run" / "figures" / "trajectories.png").exists()


def test_no_home_costs_only_the_compilation_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    def home() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", home)
    place = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    jax.config.update("jax_compilation_cache_dir", None)
    try:
        enable_compilation_cache()
        assert jax.config.jax_compilation_cache_dir is None  # type: ignore[attr-defined]
    finally:
        jax.config.update("jax_compilation_cache_dir", place)
