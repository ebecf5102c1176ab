"""The notebook is committed as it was run, and runs from top to bottom, with less training (pip install ".[notebook]")."""

import base64
import io
import json
import re
from pathlib import Path

import numpy as np
import pytest

PATH = Path(__file__).parents[2] / "docs" / "notebooks" / "first_steps.ipynb"
# what is run after it: the slider is pulled, and the sheet comes to rest
PULL = """
gravity.value = 20.0
patch.step(600)
print("slider", -patch.pulls()[0, :, 2].sum(), knit.density * 0.36 * 20.0)
"""


def texts(cell):
    return "".join("".join(output["text"]) for output in cell["outputs"] if output["output_type"] == "stream")


def test_it_is_committed_as_it_was_run():
    cells = [cell for cell in json.loads(PATH.read_text())["cells"] if cell["cell_type"] == "code"]
    assert PATH.stat().st_size < 512_000
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell["outputs"]]
    assert not any(output["output_type"] == "error" or output.get("name") == "stderr" for output in outputs)
    solved = re.search(r"(\d+)% of the held-out episodes solved", "".join(map(texts, cells)))
    assert int(solved[1]) >= 90
    # nothing of the machine that ran it
    assert f"{Path.home()}/" not in PATH.read_text().replace("//", "") and "/tmp" not in PATH.read_text()


@pytest.mark.filterwarnings("ignore")
def test_it_runs_from_top_to_bottom(tmp_path, monkeypatch):
    nbclient = pytest.importorskip("nbclient")
    nbformat = pytest.importorskip("nbformat")
    pytest.importorskip("ipywidgets")
    from PIL import Image

    monkeypatch.setenv("TRAINING_STEPS", "1280")
    notebook = nbformat.read(PATH, as_version=4)
    notebook.cells.append(nbformat.v4.new_code_cell(PULL))
    nbclient.NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(tmp_path)}}).execute()
    said = "".join(texts(cell) for cell in notebook.cells if cell["cell_type"] == "code")

    # the pins carry the sheet's weight, in the notebook's own cell and after the slider was pulled
    pull, weight = (float(re.search(rf"{name}\s+(\S+) N", said)[1]) for name in ("pull at the pins", "weight"))
    assert pull == pytest.approx(weight, rel=0.01)
    pull, weight = map(float, re.search(r"slider (\S+) (\S+)", said).groups())
    assert weight == pytest.approx(0.36 * 20 * 0.178, rel=0.01) and pull == pytest.approx(weight, rel=0.01)
    assert "1,280 steps" in said and "expert    performance  0.9" in said and "success True" in said

    pictures = [
        Image.open(io.BytesIO(base64.b64decode(data)))
        for cell in notebook.cells
        for output in cell.get("outputs", [])
        for kind, data in output.get("data", {}).items()
        if kind.startswith("image/")
    ]
    assert [picture.format for picture in pictures] == ["JPEG", "JPEG", "JPEG", "JPEG", "GIF", "JPEG"]
    assert pictures[4].n_frames > 15
    assert all(np.asarray(picture.convert("L")).std() > 5 for picture in pictures), "a picture is empty"
