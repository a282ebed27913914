"""Shipped models by name, and the command that fits models where none are shipped for a detector."""

from semfov.errors import InputError
from semfov.io.pretrained import Pretrained


def fit_command(model: str = "MODEL", out: str = "mymodels") -> str:
    """Write the command that fits all models to a detector.

    Args:
        model: name or file of the detector.
        out: folder for the models.

    Returns:
        The command line.

    >>> fit_command("mine.onnx")
    'semfov fit mine.onnx --data.root PHOTOS --data.annotations instances.json --out mymodels'
    """
    return f"semfov fit {model} --data.root PHOTOS --data.annotations instances.json --out {out}"


def shipped_model(kind: type[Pretrained], name: str, model: str) -> str:
    """Check that a model is shipped under a name.

    Args:
        kind: kind of model.
        name: name of the model for a detector and a sensor.
        model: name or file of the detector, as the user gave it.

    Returns:
        The name.

    Raises:
        InputError: no such model is shipped; the message has the command that fits one.
    """
    if (kind.shipped / f"{name}.safetensors").is_file():
        return name
    names = sorted(path.stem for path in kind.shipped.glob("*.safetensors"))
    raise InputError(
        f"detector: no {kind.title} is shipped for {name!r}, only for {', '.join(names)}; fit all models to it with "
        f"`{fit_command(model)}` or semfov.fit_detector, and load them with "
        "ActivePerception.from_pretrained('mymodels'); ActivePerception.raw needs no model"
    )
