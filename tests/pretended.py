"""A pretended accelerator: its tensors say that they are on a GPU, have their values in main memory, and refuse mixing.

Operations on tensors of two devices, and `numpy()` of a tensor that was not copied to the CPU first, fail as on a GPU.
Values are those of the CPU, so a module must give the same output there, and errors of values are raised, too.
"""

import warnings
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils._pytree import tree_flatten, tree_map_only

GPU = torch.device("cuda", 0)

_aten = torch.ops.aten
_ACROSS = (_aten._to_copy.default, _aten.copy_.default, _aten._foreach_copy_.default)
"""Operations that copy between devices."""

_BY_INDEX = (_aten.index.Tensor, _aten.index_put.default, _aten.index_put_.default, _aten._unsafe_index.Tensor)
"""Operations whose indices may be on the CPU."""


_WAITING = (
    _aten._local_scalar_dense.default,
    _aten.is_nonzero.default,
    _aten.equal.default,
    _aten.nonzero.default,
    _aten.bincount.default,
    _aten.masked_select.default,
    _aten.repeat_interleave.Tensor,
    _aten._unique2.default,
)
"""Operations that wait for a GPU, because a value or a shape depends on what it computes."""

waited: list[str] = []
"""Names of the operations since the list was cleared that would have waited for a GPU."""


class PretendedTensor(Tensor):
    """A tensor of the pretended GPU.

    Attributes:
        held: its values, on the CPU.
    """

    held: Tensor

    @staticmethod
    def __new__(cls, real: Tensor) -> "PretendedTensor":
        made: PretendedTensor = Tensor._make_wrapper_subclass(
            cls,
            real.size(),
            strides=real.stride(),
            storage_offset=real.storage_offset(),
            dtype=real.dtype,
            device=GPU,
            requires_grad=real.requires_grad,
        )
        made.held = real
        return made

    def tolist(self) -> Any:
        """The values as numbers, which a GPU gives, too."""
        waited.append("tolist")
        return self.held.tolist()

    __torch_function__ = torch._C._disabled_torch_function_impl

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


class PretendedGpu(TorchDispatchMode):
    """While it is open, tensors can be made on and moved to the pretended GPU, `torch.device("cuda", 0)`."""

    def __enter__(self) -> "PretendedGpu":
        # PyTorch would look for a driver before it dispatches an operation.
        self._lazy_init, torch.cuda._lazy_init = torch.cuda._lazy_init, lambda: None
        torch._C._ensureCUDADeviceGuardSet()
        # `torch.tensor` would copy to the device without dispatching.
        self._lifts = torch._C._only_lift_cpu_tensors()
        torch._C._set_only_lift_cpu_tensors(True)
        # In inference mode composite operations are dispatched whole, and results count no versions.
        self._inference, torch._C._InferenceMode = torch._C._InferenceMode, _no_gradients
        # The data of a parameter cannot become that of another device, so `Module.to` replaces the parameter.
        # Operations of cuDNN are chosen by the device, and do not exist on the CPU.
        self._cudnn, torch.backends.cudnn.enabled = torch.backends.cudnn.enabled, False
        self._replaces = torch.__future__.get_overwrite_module_params_on_conversion()
        torch.__future__.set_overwrite_module_params_on_conversion(True)
        return super().__enter__()

    def __exit__(self, *error: Any) -> None:
        super().__exit__(*error)
        torch.cuda._lazy_init = self._lazy_init
        torch._C._InferenceMode = self._inference
        torch.backends.cudnn.enabled = self._cudnn
        torch._C._set_only_lift_cpu_tensors(self._lifts)
        torch.__future__.set_overwrite_module_params_on_conversion(self._replaces)

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


def a_gpu() -> AbstractContextManager[object]:
    """The GPU of this machine, or the pretended one."""
    return nullcontext() if torch.cuda.is_available() else PretendedGpu()


@contextmanager
def waits() -> Iterator[list[str]]:
    """The operations that wait for the GPU while it is open."""
    found: list[str] = []
    if not torch.cuda.is_available():
        waited.clear()
        yield found
        found += waited
        return
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            yield found
    finally:
        torch.cuda.set_sync_debug_mode("default")
    found += [f"{each.filename}:{each.lineno}" for each in caught if "synchroniz" in str(each.message)]


def _no_gradients(mode: bool) -> AbstractContextManager[None]:
    return torch.no_grad() if mode else nullcontext()


def _run(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    given, _ = tree_flatten((args, kwargs))
    tensors = [each for each in given if isinstance(each, Tensor)]
    there = [each for each in tensors if isinstance(each, PretendedTensor)]
    here = [each for each in tensors if not isinstance(each, PretendedTensor) and each.dim() > 0]
    if there and here and func not in _ACROSS and not (func in _BY_INDEX and isinstance(args[0], PretendedTensor)):
        raise RuntimeError(f"{func}: expected all tensors to be on the same device, but found cuda:0 and cpu")
    device = kwargs.get("device")
    on_gpu = bool(there) if device is None else torch.device(device).type == GPU.type
    if func in _ACROSS[1:]:
        on_gpu = isinstance(args[0], PretendedTensor)
    real_args = tree_map_only(PretendedTensor, lambda each: each.held, args)
    real_kwargs = tree_map_only(PretendedTensor, lambda each: each.held, kwargs)
    if device is not None:
        real_kwargs["device"] = torch.device("cpu")
    real_kwargs.pop("pin_memory", None)
    result = func(*real_args, **real_kwargs)
    chosen = tree_flatten(args[1:])[0]
    masks = [each for each in chosen if isinstance(each, PretendedTensor) and each.dtype == torch.bool]
    if there and (func in _WAITING or (func in _BY_INDEX and masks) or (func in _ACROSS and not on_gpu)):
        waited.append(str(func))
    if not on_gpu:
        return result
    result = tree_map_only(Tensor, PretendedTensor, result)
    return return_and_correct_aliasing(func, args, kwargs, result) if there else result
