import re
from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient

DOCS = Path(__file__).parents[2] / "docs"
TUTORIALS = sorted((DOCS / "tutorials").glob("*.ipynb"))


def execute(path: Path, folder: Path) -> Any:
    notebook = nbformat.read(path, as_version=4)
    NotebookClient(
        notebook, timeout=600, kernel_name="python3", resources={"metadata": {"path": str(folder)}}
    ).execute()
    return notebook


@pytest.mark.thorough
@pytest.mark.filterwarnings("default")  # warnings of Jupyter's packages
def test_the_notebook_reads_the_log_of_a_run(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("JAXSAFE_RUN", str(whole))
    outputs = [
        output
        for cell in execute(DOCS / "episodes.ipynb", tmp_path).cells
        if cell.cell_type == "code"
        for output in cell.outputs
    ]
    text = "".join(
        output.text
        for output in outputs
        if output.output_type == "stream" and output.name == "stdout"
    )
    assert "10 episodes, " in text
    assert text.endswith("rows: consistent\n")
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 2


def shapes(outputs: list[Any]) -> list[str]:
    """Return the outputs that are tuples of shapes. Lengths of episodes are left out.

    What is learnt depends on how sums are rounded, and that on the processor.
    """
    texts = [output.get("data", {}).get("text/plain", "") for output in outputs]
    return [re.sub(r"\d{3,}", "…", text) for text in texts if text.startswith("((")]


def test_tutorials_show_what_their_code_returns() -> None:
    for path in TUTORIALS:
        cells = nbformat.read(path, as_version=4).cells
        code = [cell for cell in cells if cell.cell_type == "code"]
        assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1)), path
        assert cells[0].source.startswith("# "), path


def test_tutorials_in_one_directory_do_not_train_into_the_same_run() -> None:
    code = "\n".join(cell.source for path in TUTORIALS for cell in nbformat.read(path, 4).cells)
    names = re.findall(r'jaxsafe\.train\([^)]*out="([^"]*)"', code)
    assert names
    assert len(names) == len(set(names))


@pytest.mark.thorough
@pytest.mark.filterwarnings("default")  # warnings of Jupyter's packages
def test_a_training_loop_by_hand_learns_to_dock(tmp_path: Path) -> None:
    path = DOCS / "tutorials" / "own_training_loop.ipynb"
    stored, executed = (
        [output for cell in notebook.cells for output in cell.get("outputs", [])]
        for notebook in (nbformat.read(path, as_version=4), execute(path, tmp_path))
    )
    assert shapes(executed) == shapes(stored) != []
    [printed] = [output.text for output in executed if output.output_type == "stream"]
    before, after = map(int, re.findall(r"(\d+)% dock", printed))
    assert before < 5
    assert after >= 80


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # warnings of Jupyter's packages
@pytest.mark.parametrize("path", TUTORIALS, ids=lambda path: path.stem)
def test_a_tutorial_runs(path: Path, tmp_path: Path) -> None:
    for cell in execute(path, tmp_path).cells:
        for output in cell.get("outputs", []):
            assert output.output_type != "error"
            # Without a figure's image, its text would say only what it is.
            shown = output.get("data", {})
            assert "image/png" in shown or "<Figure" not in shown.get("text/plain", "")
