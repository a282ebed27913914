"""Descent: it goes where PyTorch's own does, and imports no compiler."""

from collections.abc import Callable

import torch
from torch import Tensor

from semfov.observation.descent import Lbfgs

PROGRAM = """
import sys
import torch
from semfov.observation.descent import Lbfgs

value = torch.ones(3, requires_grad=True)
optimiser = Lbfgs([value])

def loss():
    optimiser.zero_grad()
    result = (value - 2).square().sum()
    result.backward()
    return result

optimiser.step(loss)
assert torch.allclose(value, torch.full((3,), 2.0))
print("torch._dynamo" in sys.modules)
"""


def test_it_goes_where_that_of_pytorch_goes() -> None:
    ends = []
    for kind in (Lbfgs, torch.optim.LBFGS):
        place = torch.tensor([-1.2, 1.0], dtype=torch.float64, requires_grad=True)
        optimiser = kind([place], max_iter=40, line_search_fn="strong_wolfe")

        def valley(place: Tensor = place, optimiser: torch.optim.LBFGS = optimiser) -> Tensor:
            optimiser.zero_grad()
            height = (1 - place[0]) ** 2 + 100 * (place[1] - place[0] ** 2) ** 2
            height.backward()
            return height

        optimiser.step(valley)
        ends.append(place.detach())
    assert torch.equal(*ends)
    assert torch.allclose(ends[0], torch.ones(2).double(), atol=1e-4)  # the minimum of Rosenbrock's function


def test_it_imports_no_compiler(fresh: Callable[[str], str]) -> None:
    assert fresh(PROGRAM).strip() == "False"
