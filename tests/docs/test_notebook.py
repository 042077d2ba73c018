from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOK = Path(__file__).parents[2] / "docs" / "episodes.ipynb"


def execute(folder: Path) -> Any:
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    NotebookClient(
        notebook, timeout=600, kernel_name="python3", resources={"metadata": {"path": str(folder)}}
    ).execute()
    return notebook


@pytest.mark.filterwarnings("default")  # warnings of Jupyter's packages
def test_the_notebook_reads_the_log_of_a_run(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("JAXSAFE_RUN", str(whole))
    outputs = [
        output
        for cell in execute(tmp_path).cells
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
