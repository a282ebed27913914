"""What to do where no model is shipped for a detector."""

from semfov.errors import InputError
from semfov.io.pretrained import Pretrained


def fit_command(model: str = "MODEL", out: str = "mymodels") -> str:
    """The command that fits everything to a detector.

    >>> fit_command("mine.onnx")
    'python -m train.fit_detector mine.onnx --data.root PHOTOS --data.annotations instances.json --out mymodels'
    """
    return f"python -m train.fit_detector {model} --data.root PHOTOS --data.annotations instances.json --out {out}"


def shipped_model(kind: type[Pretrained], name: str, model: str) -> str:
    """The name, where a model of this kind is shipped under it.

    Args:
        kind: of model.
        name: that it has for detector and sensor.
        model: what the user calls the detector.

    Raises:
        InputError: none is shipped; the message has the command that makes it.
    """
    if (kind.shipped / f"{name}.safetensors").is_file():
        return name
    known = sorted(path.stem for path in kind.shipped.glob("*.safetensors"))
    raise InputError(
        f"detector: no {kind.title} is shipped for {name!r} (but for {', '.join(known)}); fit everything to it by "
        f"`{fit_command(model)}` or semfov.fit_detector, and load that by "
        "ActivePerception.from_pretrained('mymodels'); ActivePerception.raw needs no model"
    )
