from pathlib import Path

import pytest

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))
TIMEOUT_SECONDS = 600


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # the kernel's own libraries warn as they please
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs_from_top_to_bottom(path, tmp_path):
    import nbformat
    from nbclient import NotebookClient

    notebook = nbformat.read(path, as_version=4)
    committed = [cell for cell in notebook.cells if cell.cell_type == "code" and "image/png" in str(cell.outputs)]
    assert committed, f"{path.name} is committed without its images"
    NotebookClient(notebook, timeout=TIMEOUT_SECONDS, resources={"metadata": {"path": tmp_path}}).execute()
    assert sum("image/png" in str(cell.outputs) for cell in notebook.cells if cell.cell_type == "code") >= len(
        committed
    )
