"""A figure as the last value of a notebook cell."""

import pytest

CODE = """
from IPython.core.interactiveshell import InteractiveShell
from matplotlib.figure import Figure

from semfov.viz import plot_reliability
import torch

shell = InteractiveShell.instance()
plain, _ = shell.display_formatter.format(Figure().add_subplot().figure)
figure = plot_reliability({"model": (torch.rand(50, 3).softmax(-1), torch.randint(3, (50,)))})
drawn, _ = shell.display_formatter.format(figure)
print("image/png" in plain, drawn["image/png"][:4] == b"\\x89PNG", drawn["image/png"].count(b"IEND"))
"""


LOOP = """
from IPython.core.interactiveshell import InteractiveShell
from IPython.utils.capture import capture_output

shell = InteractiveShell.instance()
shell.kernel = object()  # as in a notebook
shell.run_cell("from semfov.viz import plot_reliability; import torch")
shell.run_cell("draw = lambda: plot_reliability({'m': (torch.rand(50, 3).softmax(-1), torch.randint(3, (50,)))})")
for cell in ("for number in range(2): draw()", "kept = draw()", "draw()", "1"):
    with capture_output() as shown:
        shell.run_cell(cell)
    print(sum("image/png" in each.data for each in shown.outputs))
"""


def test_figures_are_displayed_once(fresh):
    # Plain Matplotlib figures are not: notebooks can display them only after pyplot is imported.
    pytest.importorskip("IPython", reason="needs IPython (pip install semfov[docs])")
    assert fresh(CODE).split() == ["False", "True", "1"]
    # The last value of a cell is its result, which is shown in another way.
    assert fresh(LOOP).split() == ["2", "1", "0", "0"]
