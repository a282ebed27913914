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


def test_a_figure_is_displayed_before_pyplot_is_imported(fresh):
    """Plain Matplotlib figures are not: notebooks can display them only after pyplot is imported."""
    pytest.importorskip("IPython", reason="needs IPython (pip install semfov[docs])")
    assert fresh(CODE).split() == ["False", "True", "1"]
