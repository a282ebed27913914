"""Errors that a user can act on, and the checks that raise them."""

import math
import unicodedata
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from functools import wraps
from inspect import Signature, signature
from numbers import Integral, Real
from typing import ParamSpec, TypeVar

import torch
from torch import Tensor

from semfov.words import FORMER, MAKERS, OPTIONS, meant_options, note_of_former, other_method, parts_of

__all__ = ["DataError", "InputError", "SemfovError"]

_ROUNDING = 1e-3

_Name = TypeVar("_Name", bound=str)
_Given = ParamSpec("_Given")
_Result = TypeVar("_Result")


def printable(text: str) -> str:
    """Escape control characters, and bytes of names that are not UTF-8; lines stay."""
    return "".join(ascii(character)[1:-1] if _steers(character) else character for character in text)


def _steers(character: str) -> bool:
    """Tell whether a character can steer a terminal: a control, a mark of direction or a lone surrogate."""
    return unicodedata.category(character) in ("Cc", "Cf", "Cs") and character not in "\n\t"


class SemfovError(Exception):
    """Base of every error that semfov raises on purpose; the message names what is wrong and how to correct it."""

    def __str__(self) -> str:
        """Return the message, in which names of files cannot steer a terminal."""
        return printable(super().__str__())


class InputError(SemfovError, ValueError):
    """An argument, a setting or a tensor does not have the value, type or shape that the call needs."""


class DataError(SemfovError):
    """A file (image, annotations, weights, cache) is missing, damaged or of the wrong shape."""


def reason_of(error: BaseException) -> str:
    """Write the message of another library's error on one line, for a message of ours; empty where it has none."""
    return " ".join(str(error).split())


def type_of(value: object) -> str:
    """Return the type of a value with its article, such as `an int`, for a message."""
    name = type(value).__name__
    return f"{'an' if name[0] in 'aeiouAEIOU' else 'a'} {name}"


def check(condition: bool, argument: str, expected: str, got: object) -> None:
    """Raise `InputError` unless a condition holds.

    Args:
        condition: what must hold.
        argument: name of the argument that is checked.
        expected: the values that are allowed, in words.
        got: the value, or what is wrong with it and how to correct it.
    """
    if not condition:
        raise InputError(f"{argument}: expected {expected}, got {got}")


def check_data(condition: bool, where: object, expected: str, got: object) -> None:
    """Raise `DataError` (something in a file is wrong) unless a condition holds.

    Args:
        condition: what must hold.
        where: the file, or the place in it.
        expected: what it should hold, in words.
        got: what it holds instead.
    """
    if not condition:
        raise DataError(f"{where}: expected {expected}, got {got}")


@contextmanager
def needing(
    package: str, what: object, install: str | None = None, error: type[SemfovError] = InputError
) -> Iterator[None]:
    """Open a block that imports a package which need not be there.

    Args:
        package: name of the package.
        what: what needs it: an argument, a method or a file.
        install: what pip installs; None for the package itself.
        error: class of the error that says how the package is installed.
    """
    try:
        yield
    except ImportError:
        remedy = f"pip install {install or package}"
        raise error(f"{what}: expected the package {package}, which is not installed; {remedy}") from None


def values_known(*tensors: Tensor) -> bool:
    """Tell whether the values of tensors can be read: not while traced, under `torch.func`, or on the device `meta`."""
    if torch.compiler.is_compiling():
        return False
    try:
        for tensor in tensors:
            if tensor.is_meta:
                return False
            # A transform wraps its tensors, and a wrapped tensor has no memory of its own.
            tensor.data_ptr()
    except RuntimeError:
        return False
    return True


def check_device(device: object) -> None:
    """Raise `InputError` unless PyTorch has a device here; None is the processor."""
    try:
        torch.empty(0, device=device).cpu()  # type: ignore[call-overload]  # from `meta` nothing comes back
    except (RuntimeError, AssertionError, TypeError):
        got = repr(str(device) if isinstance(device, torch.device) else device)
        check(False, "device", f"one that PyTorch has here ({', '.join(devices_here())})", got)


def check_is_device(device: object) -> None:
    """Raise `InputError` for what PyTorch does not take as a device, on any machine."""
    try:
        torch.device(device)  # type: ignore[call-overload]
    except (RuntimeError, TypeError):
        raise InputError(f"device: expected a device of PyTorch, such as cpu or cuda, got {device!r}") from None


def check_where_to(*arguments: object, **options: object) -> None:
    """Check a device that the arguments of a module's method `to` name by a text."""
    device = options.get("device", next(iter(arguments), None))
    if isinstance(device, str):
        check_is_device(device)


def devices_here() -> list[str]:
    """List the kinds of devices that PyTorch has on this machine."""
    is_here = {"cpu": True, "cuda": torch.cuda.is_available(), "mps": torch.mps.is_available()}
    return [device for device in is_here if is_here[device]]


def check_shape(tensor: Tensor, argument: str, *shape: int | None) -> None:
    """Raise `InputError` unless the last dimensions of a tensor have the given sizes; None stands for any."""
    check_tensor(tensor, argument)
    sizes = tuple(tensor.shape[-len(shape) :])
    has_shape = len(sizes) == len(shape) and all(map(_is_size, sizes, shape))
    if not has_shape:
        # The message is built only now, because a graph with dynamic sizes cannot write the sizes out.
        expected = ", ".join("any" if size is None else str(size) for size in shape)
        check(False, argument, f"a tensor of shape (..., {expected})", tuple(tensor.shape))


def _is_size(size: int, expected: int | None) -> bool:
    """Tell whether a dimension has the size that is expected; None stands for any."""
    return expected is None or size == expected


def check_tensor(value: object, argument: str) -> None:
    """Raise `InputError` unless a value is a tensor; the message has the call that converts it."""
    if isinstance(value, Tensor):
        return
    kind = "a NumPy array" if type(value).__name__ == "ndarray" else type_of(value)
    check(False, argument, "a tensor", f"{kind}; give torch.as_tensor({argument})")


def check_whole(value: object, argument: str, low: int, high: int) -> None:
    """Raise `InputError` unless a value is a whole number in a range."""
    inside = isinstance(value, Integral) and not isinstance(value, bool) and low <= int(value) <= high
    check(inside, argument, f"a whole number from {low:,} to {high:,}", repr(value))


def check_number(value: object, argument: str, low: float, high: float) -> None:
    """Raise `InputError` unless a value is a number in a range."""
    inside = isinstance(value, Real) and not isinstance(value, bool) and low <= float(value) <= high
    check(inside, argument, f"a number from {low:g} to {high:g}", repr(value))


def check_pixels(image: Tensor, argument: str) -> None:
    """Raise `InputError` unless the values of an image lie in [0, 1], up to rounding, with how to bring them there."""
    if not values_known(image) or not image.numel():
        return
    # In the order of memory, which is several times faster than across it.
    in_memory = image.detach().permute(sorted(range(image.ndim), key=image.stride, reverse=True))
    low, high = torch.stack(in_memory.aminmax()).tolist()
    inside = low >= -_ROUNDING and high <= 1 + _ROUNDING
    got = "NaN" if math.isnan(low) else f"numbers from {low:g} to {high:g}"
    check(inside, argument, "RGB in [0, 1]", f"{got}; {_to_unit(low, high)}")


def _to_unit(low: float, high: float) -> str:
    """Say how to bring pixels from `low` to `high` into [0, 1]."""
    if not math.isfinite(low + high):
        return "replace NaN and infinite values (torch.nan_to_num)"
    if low >= -0.25 and high <= 1.25:
        return "clamp to [0, 1] the values that resampling has moved outside"
    if low < 0:
        return (
            "undo the normalisation: image * std + mean, for ImageNet with mean (0.485, 0.456, 0.406) and std "
            "(0.229, 0.224, 0.225), or (image + 1) / 2 for an image normalised to [-1, 1]"
        )
    return "divide by 255" if high <= 255.5 else "divide by the value of white"


def check_finite(tensor: Tensor, argument: str) -> None:
    """Raise `InputError` where a tensor holds a NaN or an infinite value."""
    if not values_known(tensor):
        return
    finite = torch.isfinite(tensor)
    if not bool(finite.all()):
        bad = tensor.numel() - int(finite.sum())
        check(False, argument, "finite numbers", f"{bad} of {tensor.numel()} that are not finite")


def lookup(name: str, known: Iterable[_Name], what: str) -> _Name:
    """Return a name if it is known.

    Args:
        name: the name.
        known: the names that there are.
        what: what the names are of, for the message.

    Returns:
        The known name that is equal to it.

    Raises:
        InputError: there is no such name; the message has the nearest ones.
    """
    names = list(known)
    if name in names:
        return names[names.index(name)]
    similar = _similar_names(str(name), names)
    hint = f"did you mean {' or '.join(map(repr, similar))}?" if similar else f"known: {', '.join(names) or 'none'}"
    raise InputError(f"unknown {what} {name!r}; {hint}")


def _similar_names(name: str, known: Sequence[str]) -> list[str]:
    """List up to three known names that are nearest to a name, first those that begin with it."""
    # Of `yolox`, `yolox-nano` differs in more letters than `yolov3`.
    longer = [longer_name for longer_name in known if name and longer_name.startswith(name)]
    beginning_with_it = get_close_matches(name, longer, n=3, cutoff=0.0)
    close = get_close_matches(name, known, n=3, cutoff=0.5)
    return list(dict.fromkeys([*beginning_with_it, *close]))[:3]


def check_options(options: Iterable[str], known: Iterable[str], what: str) -> None:
    """Raise `InputError` for the first unknown option of a call that passes its options on.

    Args:
        options: names of the options of the call.
        known: names of the options that there are.
        what: what takes them, for the message.
    """
    names = list(dict.fromkeys(known))
    for name in options:
        if name not in names:
            hint = _hint(what, name, names) or f"known: {', '.join(names) or 'none'}"
            raise InputError(f"{name}: expected an option of {what}, got an unknown one; {hint}")


def _hint(what: str, name: str, known: list[str]) -> str:
    """Say what has an option that others call by a name, or which one has a similar name; empty if none is known."""
    hint = _remedy(what, name, known) or _question(get_close_matches(name, known, cutoff=0.7))
    for part in [] if name in OPTIONS else parts_of(name):
        hint = hint or _remedy(what, part, known)
    return hint


def _remedy(what: str, word: str, known: list[str]) -> str:
    """Say what has the option that others call by a word; empty if the word is not listed."""
    return other_method(what, word, known) or _question(meant_options(word, known))


def _question(options: list[str]) -> str:
    """Ask whether one of some options is meant; empty if there are none."""
    return f"did you mean {' or '.join(f'{option}=' for option in options)}?" if options else ""


def rename_former(options: dict[str, object], known: Collection[str]) -> None:
    """Rename options with earlier names to their present names, with a warning for each.

    Args:
        options: the options of the call of a function, which are changed.
        known: names of the options that there are.

    Raises:
        InputError: an option is given by both of its names.
    """
    for former in FORMER.keys() & options.keys():
        present = FORMER[former]
        if present in known:
            check(present not in options, present, "one value", f"another as {former}, its earlier name")
            warnings.warn(note_of_former(former, present), FutureWarning, stacklevel=3)  # of who calls the function
            options[present] = options.pop(former)


def former_keywords(function: Callable[_Given, _Result]) -> Callable[_Given, _Result]:
    """Decorate a function so that it takes settings by their earlier names, too, with a warning."""
    known = signature(function).parameters

    @wraps(function)
    def call(*arguments: _Given.args, **options: _Given.kwargs) -> _Result:
        rename_former(options, known)
        return function(*arguments, **options)

    return call


def checked_keywords(function: Callable[_Given, _Result]) -> Callable[_Given, _Result]:
    """Decorate a function or a method so that wrong arguments raise `InputError` with a suggestion."""
    form = signature(function)
    name = function.__qualname__.removesuffix(".__init__").rpartition(".")[-1]
    known = [parameter for parameter in form.parameters if parameter != "self"]

    @wraps(function)
    def call(*arguments: _Given.args, **options: _Given.kwargs) -> _Result:
        rename_former(options, known)
        check_options(options, known, name)
        try:
            form.bind(*arguments, **options)
        except TypeError as error:
            remedy = _right_form(name, form, len(arguments))
            raise InputError(f"{name}: {error}; {remedy}") from None
        return function(*arguments, **options)

    return call


def _right_form(name: str, form: Signature, number: int) -> str:
    """Say how a function or a method is called, or what else takes what it was given.

    Args:
        name: its name.
        form: its signature.
        number: number of arguments, of a method with `self`, that were given without a name.
    """
    parameters = [p for p in form.parameters.values() if p.name != "self"]
    words = [p.name if p.default is p.empty else f"{p.name}=" for p in parameters]
    remedy = f"expected {', '.join(words)}"
    unnamed = [p for p in form.parameters.values() if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    if number > len(unnamed):
        # What is given without a name, beside the picture, is what others look for.
        remedy = other_method(name, "target", [p.name for p in parameters]) or remedy
    return f"{remedy}; {MAKERS[name]} makes one" if name in MAKERS else remedy
