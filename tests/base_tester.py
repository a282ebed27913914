"""Tests that every public module must pass when it is a part of a user's own module.

A test class derives from a tester, is named after its module (`class TestFoveation(GraphTester)`), and defines how
the module is made (`make`), which tensors it takes (`inputs`) and how it is called with them (`call`, if that is not
`module(*inputs)`). It inherits the tests. `GraphTester` is for modules that are one graph of differentiable
operations, `TensorTester` for modules whose operations depend on values, `BaseTester` for modules that take images of
bytes or scenes. A test that does not apply to a module is switched off by name, with the reason
(`test_no_rows = None`). `make_testers` makes several classes that have nothing but `make`.
A public module without a tester fails `tests/test_modules.py`.
"""

import copy
import io
import pickle
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import pytest
import torch
from torch import Tensor, nn


class Host(nn.Module):
    """A user's module: it multiplies the output of its part by a parameter."""

    def __init__(self, part: nn.Module, call: Any) -> None:
        super().__init__()
        self.part = part
        self.call = call
        self.gain = nn.Parameter(torch.tensor(2.0))

    def forward(self, *inputs: Tensor) -> Tensor:
        result = self.call(self.part, *inputs)
        return self.gain.to(result.device) * result


class BaseTester:
    """Tests of any module: it runs on every device, and it can be saved, loaded and copied."""

    # Whether its results are on the CPU, wherever it is: looks at windows and scenes come back from the detector.
    on_cpu: ClassVar[bool] = False

    def make(self) -> nn.Module:
        """A small instance of the module, made from seeded random numbers."""
        raise NotImplementedError

    def inputs(self) -> tuple[Any, ...]:
        """Small inputs of the module."""
        raise NotImplementedError

    @staticmethod
    def call(module: Any, *inputs: Any) -> Tensor:
        """Call the module and return one tensor of its output."""
        return module(*inputs)

    def host(self, call: Callable[..., Tensor] | None = None) -> Host:
        """The module as a part of another one, which calls it by `call` unless another way is given."""
        with torch.random.fork_rng():
            torch.manual_seed(0)
            return Host(self.make(), call or self.call)

    def test_smoke(self) -> None:
        """It returns numbers, returns the same numbers again, and does not change its inputs."""
        host, inputs = self.host(), self.inputs()
        assert type(self).__name__.startswith(f"Test{type(host.part).__name__}")
        given = copy.deepcopy(inputs)
        result = host(*inputs)
        assert result.numel() > 0
        assert not result.isnan().any()
        assert torch.equal(host(*inputs), result)
        for now, before in zip(inputs, given, strict=True):
            assert not isinstance(now, Tensor) or torch.equal(now, before)
        assert type(host.part).__name__ in repr(host)

    def test_state(self) -> None:
        """Its parameters and buffers can be saved and loaded, and the file holds all changed values."""
        host, other, inputs = self.host(), self.host(), self.inputs()
        with torch.no_grad():
            for parameter in host.parameters():
                parameter.mul_(1.25)
        file = io.BytesIO()
        torch.save(host.state_dict(), file)
        file.seek(0)
        other.load_state_dict(torch.load(file, weights_only=True))
        assert torch.equal(host(*inputs), other(*inputs))

    @pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda host: pickle.loads(pickle.dumps(host))])
    def test_copies(self, duplicate: Any) -> None:
        """A copy gives the same output and shares no memory with the original."""
        host, inputs = self.host(), self.inputs()
        before = host(*inputs)
        twin = duplicate(host)
        assert torch.equal(twin(*inputs), before)
        with torch.no_grad():
            for tensor in (*twin.parameters(), *twin.buffers()):
                if tensor.is_floating_point():
                    tensor.zero_()
        assert torch.equal(host(*inputs), before)

    def test_device(self, device: torch.device) -> None:
        """It runs on the device of its inputs, gives the values of the CPU there, and stays where it was put."""
        host = self.host().to(device)
        result = host(*(x.to(device) for x in self.inputs()))
        assert {tensor.device.type for tensor in host.parameters()} <= {device.type}
        assert result.device.type == ("cpu" if self.on_cpu else device.type)
        torch.testing.assert_close(result.cpu(), self.host()(*self.inputs()), rtol=1e-3, atol=1e-4)


def make_testers(base: type[BaseTester], makers: Mapping[str, Callable[[], nn.Module]]) -> dict[str, type]:
    """Testers of modules that differ only in how they are made, to be added to the names of a test file."""
    return {f"Test{name}": type(f"Test{name}", (base,), {"make": staticmethod(make)}) for name, make in makers.items()}


class TensorTester(BaseTester):
    """Tests of modules that take tensors: batches and dtypes."""

    # Indices of the inputs whose first dimension is the batch.
    batched: ClassVar[tuple[int, ...]] = (0,)
    # bfloat16 has 8 significant bits: rounding errors are up to 2^-9 (0.2 %), and larger where similar values are
    # subtracted.
    autocast = 0.02

    def test_shapes(self) -> None:
        """A row gives the same output in a batch and alone."""
        host, inputs = self.host(), self.inputs()
        rows = len(inputs[self.batched[0]])
        assert rows > 1, "the inputs of a tester must have at least two rows"
        whole = host(*inputs)
        for row in range(rows):
            torch.testing.assert_close(host(*self.rows(row, row + 1)), whole[row : row + 1])

    def test_no_rows(self) -> None:
        """An empty batch gives an empty batch."""
        host = self.host()
        assert host(*self.rows(0, 0)).shape == (0, *host(*self.inputs()).shape[1:])

    def rows(self, start: int, stop: int) -> tuple[Tensor, ...]:
        """The inputs, with the given rows of each batched one."""
        return tuple(x[start:stop] if n in self.batched else x for n, x in enumerate(self.inputs()))

    def test_dtypes(self, dtype: torch.dtype) -> None:
        """The output has the dtype of the module and its inputs."""
        expected = self.host()(*self.inputs())
        result = self.host().to(dtype)(*(x.to(dtype) if x.is_floating_point() else x for x in self.inputs()))
        assert result.dtype == dtype
        torch.testing.assert_close(result.to(expected), expected, rtol=1e-3, atol=1e-4)

    def test_autocast(self) -> None:
        """It tolerates automatic mixed precision (bfloat16)."""
        host, inputs = self.host().requires_grad_(False), self.inputs()
        expected = host(*inputs)
        with torch.autocast("cpu", torch.bfloat16):
            result = host(*inputs)
        assert bool(torch.isfinite(result).all())
        scale = float(expected.abs().max().clamp(min=1e-6))
        assert float((result.float() - expected).abs().max()) <= self.autocast * scale


def graphs_of(module: Callable[..., Tensor], *inputs: Tensor) -> list[torch.fx.GraphModule]:
    """The graphs that a plain `torch.compile` makes of a module, which must compute what the module does.

    `fullgraph=True` would not do: it traces operations at which a plain call ends a graph and begins another one.
    """
    graphs: list[torch.fx.GraphModule] = []

    def keep(graph: torch.fx.GraphModule, _: list[Tensor]) -> Callable[..., Any]:
        graphs.append(graph)
        return graph.forward

    torch.compiler.reset()
    compiled = torch.compile(module, backend=keep)
    torch.testing.assert_close(compiled(*inputs), module(*inputs), rtol=1e-4, atol=1e-5)
    return graphs


class GraphTester(TensorTester):
    """Tests of modules that are one graph of differentiable operations: gradients, compiling, export and `vmap`."""

    # Indices of the inputs with respect to which it is differentiable.
    differentiable: ClassVar[tuple[int, ...]] = (0,)

    def test_gradcheck(self) -> None:
        """Gradients with respect to inputs and parameters equal finite differences."""
        host = self.host().double()
        inputs = [x.double() if x.is_floating_point() else x for x in self.inputs()]
        for number in self.differentiable:
            inputs[number].requires_grad_()
        names, parameters = zip(*((n, p) for n, p in host.named_parameters() if p.requires_grad), strict=True)

        def result(*values: Tensor) -> Tensor:
            given = dict(zip(names, values[len(inputs) :], strict=True))
            return torch.func.functional_call(host, given, values[: len(inputs)])

        assert torch.autograd.gradcheck(result, (*inputs, *parameters), fast_mode=True)

    def traced(self) -> Host:
        """The host whose graph is traced; a tester may give one that repeats no part of it."""
        return self.host()

    @pytest.mark.slow
    def test_export(self) -> None:
        """The compiler traces it as a single graph as users call it, and the exporter, which runs it, exports it."""
        host, inputs = self.traced(), self.inputs()
        assert len(graphs_of(host, *inputs)) == 1
        program = torch.export.export(host, inputs, strict=False)  # as by default; the compiler has traced it already
        torch.testing.assert_close(program.module()(*inputs), host(*inputs), rtol=1e-4, atol=1e-5)

    def test_vmap(self) -> None:
        """`vmap` can vectorise it over its first input: images, beliefs or scores."""
        host = self.host().requires_grad_(False)
        first, *others = self.inputs()
        many = torch.stack([first, first.flip(-1), first.flip(0)])
        expected = torch.stack([host(each, *others) for each in many])
        together = torch.func.vmap(lambda each: host(each, *others))(many)
        torch.testing.assert_close(together, expected, rtol=1e-4, atol=1e-5)
