"""The density of people's fixations, predicted from a detector's feature maps."""

from collections.abc import Mapping, Sequence
from copy import deepcopy
from functools import cache
from os import PathLike
from pathlib import Path
from typing import ClassVar, Self

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from semfov.detection import Detector, FeatureMaps
from semfov.detection.weights import WEIGHTS
from semfov.errors import InputError, check, check_shape
from semfov.gaze.saliency.likeness import PictureLikeness
from semfov.gaze.saliency.oculomotor import OculomotorBias
from semfov.gaze.saliency.on_picture import on_picture, sides_of
from semfov.io.compatibility import check_same_detector
from semfov.io.files import JsonObject
from semfov.io.pretrained import Pretrained
from semfov.io.schema import Array, Field, Schema, Text
from semfov.io.schema import Number as JsonNumber

_CELLS = 52  # cells along the longer side of a picture in which densities are computed

_HALF = torch.float16


class FixationDensity(Pretrained):
    r"""Log density of the next fixation of people who view a picture freely, from the feature maps of a detector.

    .. math:: \ln p(u \mid f_1 \ldots f_n) = g_n \, m(u) + h_n \, w \, c(u) + o(u \mid f_1 \ldots f_n) - \ln Z

    m is the map: 1 × 1 convolutions of the feature maps, joined bilinearly on the picture, two more of few channels,
    and a Gaussian blur; the mean of several such readouts. c is the log density of the centre bias. With a scanpath,
    o are the oculomotor biases (`OculomotorBias`), and g and h depend on the number of fixations; without one, o is 0,
    and g and h are 1. The form is that of DeepGaze II and III (Kümmerer, Wallis, Gatys and Bethge, 2017; Kümmerer,
    Bethge and Wallis, 2022), with the features of a detector that runs anyway in place of a network of its own.

    The shipped models (`from_pretrained`) are fitted by maximum likelihood to fixations of 3 to 5 seconds of free
    viewing of photographs by adults (`semfov fit`). They are not for tasks, such as search.

    Args:
        layers: number of channels of each feature map, by the name that `Detector.features` gives it.
        readouts: number of readouts whose mean is the map.
        units: number of channels of a readout.
        centre: `(rows, columns)`, log density of the centre bias; None for none.
        metadata: JSON values to keep with the model; `detector` holds those settings of the detector that the feature
            maps depend on.

    Attributes:
        likeness: how unlike the pictures of the fit a picture is; None where that was not fitted.

    Shape:
        - features: maps `(B, C, h, w)` by name
        - output: `(B, H, W)`, natural logarithms that sum to one as densities

    Raises:
        InputError: there is no layer, or a number is below 1.

    >>> model = FixationDensity({"backbone8": 3, "head16": 5})
    >>> maps = {"backbone8": torch.rand(1, 3, 30, 40), "head16": torch.rand(1, 5, 15, 20)}
    >>> density = model(maps, (60, 80))
    >>> density.shape, round(density.exp().sum().item(), 4)
    (torch.Size([1, 60, 80]), 1.0)
    """

    kind: ClassVar[str] = "fixation-density"
    title: ClassVar[str] = "model of where people look"
    shipped: ClassVar[Path] = Path(__file__).parent.parent / "models" / "fixations"
    data: ClassVar[str] = "--gaze.fixations people.csv --gaze.pictures PHOTOS"
    schema: ClassVar[Schema] = Schema(
        {
            "read": Field(("U", "C"), _HALF),
            "shift": Field(("U",), low=-1e4, high=1e4),
            "mix": Field(("R", "N", "N"), _HALF),
            "mix_shift": Field(("R", "N"), low=-1e4, high=1e4),
            "out": Field(("R", "N"), low=-1e4, high=1e4),
            "blur": Field((), low=-10, high=5),
            "centre": Field(("Y", "X"), low=-1e3, high=0),
            "centre_weight": Field((), low=-1e2, high=1e2),
            "oculomotor.saccade": Field((7, 13), low=-1e2, high=1e2),
            "oculomotor.turn": Field((3, 13), low=-1e2, high=1e2),
            "oculomotor.back": Field((4, 6), low=-1e2, high=1e2),
            "oculomotor.gain": Field((2, 12), low=-1e2, high=1e2),
            "start": Field((2, 2), low=0, high=1),
            "duration": Field(("D", 2), low=0, high=1e2),
            "pause": Field((), low=0, high=1e4),
            "likeness.mean": Field(("P",), low=-1e4, high=1e4, optional=True),
            "likeness.deviation": Field(("P",), above=0, high=1e4, optional=True),
            "likeness.axes": Field(("K", "P"), low=-1, high=1, optional=True),
            "likeness.variance": Field(("K",), above=0, high=1e6, optional=True),
            "likeness.rest": Field((), above=0, high=1e6, optional=True),
            "likeness.limit": Field((), above=0, high=1e6, optional=True),
        },
        {"layers": Array(Array((Text(), JsonNumber(low=1, high=1e6, whole=True))), least=1)},
    )
    start: Tensor
    duration: Tensor
    pause: Tensor
    centre: Tensor

    def __init__(
        self,
        layers: Mapping[str, int],
        *,
        readouts: int = 1,
        units: int = 16,
        centre: Tensor | None = None,
        metadata: Mapping[str, object] | None = None,
    ) -> None:
        super().__init__()
        check(len(layers) > 0, "layers", "at least one feature map", "none")
        check(min(readouts, units, *layers.values()) >= 1, "readouts, units, layers", "at least 1", (readouts, units))
        self.layers = dict(layers)
        self.metadata = dict(metadata or {})
        channels = sum(layers.values())
        self.read = nn.Parameter(torch.randn(readouts * units, channels) / channels**0.5)
        self.shift = nn.Parameter(torch.zeros(readouts * units))
        self.mix = nn.Parameter(torch.randn(readouts, units, units) * 0.6 / units**0.5)
        self.mix_shift = nn.Parameter(torch.zeros(readouts, units))
        self.out = nn.Parameter(torch.randn(readouts, units) * 0.6 / units**0.5)
        self.blur = nn.Parameter(torch.zeros(()))  # logarithm of the standard deviation in cells
        self.centre_weight = nn.Parameter(torch.ones(()))
        self.oculomotor = OculomotorBias()
        flat = torch.zeros(1, 1)
        self.register_buffer("centre", flat if centre is None else centre.detach().clone())
        # Of the first fixation: mean and standard deviation of x and y, in widths and heights. Then for the fixations
        # in order, mean and standard deviation of the logarithm of the duration in ms, and the pause between two in ms.
        self.register_buffer("start", torch.tensor([[0.5, 0.5], [0.12, 0.12]]))
        self.register_buffer("duration", torch.tensor([[5.3, 0.55]]))
        self.register_buffer("pause", torch.tensor(40.0))
        self.likeness: PictureLikeness | None = None

    @classmethod
    def from_pretrained(cls, name_or_path: str | PathLike[str]) -> Self:
        """Load a shipped model, a file that `save` wrote, or the model in a folder of `semfov fit`.

        Args:
            name_or_path: name of a shipped model, or path of a file or of a folder that holds `gaze.safetensors`.

        Returns:
            The model, in `eval` mode.

        Raises:
            InputError: no model of that name is shipped.
            DataError: the file is missing, damaged or of another kind.
        """
        fitted = Path(name_or_path, "gaze.safetensors")
        shipped = (cls.shipped / f"{name_or_path}.safetensors").is_file()
        return super().from_pretrained(fitted if fitted.is_file() and not shipped else name_or_path)

    @classmethod
    def for_detector(cls, detector: Detector) -> Self:
        """Return the model that is shipped for a detector.

        Args:
            detector: the detector.

        Returns:
            The model, in `eval` mode.

        Raises:
            InputError: none is shipped for it; the message has the command that fits one.
        """
        model = deepcopy(shared_density(detector))
        assert isinstance(model, cls)
        return model

    def check_compatible(self, detector: Detector) -> None:
        """Raise `InputError` if the model was fitted for another detector; warn if a setting differs.

        Args:
            detector: the detector whose feature maps are read.
        """
        fitted = self.metadata.get("detector", {})
        settings = detector.settings()
        check_same_detector(fitted, {name: settings.get(name) for name in fitted}, self.title)

    def forward(
        self,
        features: FeatureMaps | Mapping[str, Tensor],
        size: tuple[int, int] | None = None,
        scanpath: Tensor | None = None,
        *,
        without: Sequence[str] = (),
    ) -> Tensor:
        """Compute the log density of the next fixation over the pixels of the picture.

        Args:
            features: `Detector.features` of the pictures, or maps by name that cover the whole picture.
            size: `(height, width)` of the picture in pixels; None takes that of `features`, or of its finest map.
            scanpath: `(B, n, 2)`, fixations so far in pixels of the picture, the last one last, NaN before a shorter
                path; None for the density of all fixations.
            without: terms to leave out: `map`, `centre bias`, `oculomotor biases`.

        Returns:
            `(B, H, W)`, natural logarithms.

        Raises:
            InputError: a feature map is missing or has another number of channels, or there is no such term.
        """
        if size is None:
            size = _size_of(features)
        terms = self.terms(features, size, scanpath)
        for name in without:
            check(name in ("map", "centre bias", "oculomotor biases"), "without", "terms of the model", repr(name))
        summands = [term for name, term in terms.items() if name not in without]
        log_weights = torch.stack(summands).sum(0) if summands else torch.zeros_like(terms["map"])
        if log_weights.shape[-2:] != size:
            log_weights = F.interpolate(log_weights[:, None], size, mode="bilinear", align_corners=False)[:, 0]
        # Normalised over the pixels, after the interpolation.
        return log_weights - log_weights.flatten(1).logsumexp(1)[:, None, None]

    def terms(
        self, features: FeatureMaps | Mapping[str, Tensor], size: tuple[int, int], scanpath: Tensor | None = None
    ) -> dict[str, Tensor]:
        """Compute the terms of the log density by name, up to a constant.

        Args:
            features: as for `forward`.
            size: `(height, width)` of the picture in pixels.
            scanpath: as for `forward`.

        Returns:
            `map`, `centre bias`, and with a scanpath `oculomotor biases`, each `(B, rows, columns)` over 52 cells along
            the longer side.
        """
        terms = {"map": self.map(features, size), "centre bias": self.centre_bias(size)[None]}
        if scanpath is not None:
            return self.given(terms, size, scanpath)
        terms["centre bias"] = terms["centre bias"].expand_as(terms["map"])
        return terms

    def map(self, features: FeatureMaps | Mapping[str, Tensor], size: tuple[int, int]) -> Tensor:
        """Compute the map m over the cells of pictures.

        Args:
            features: as for `forward`.
            size: `(height, width)` of the pictures in pixels.

        Returns:
            `(B, rows, columns)`.
        """
        return blurred(self.readouts(features, size).mean(1), self.blur.exp())

    def readouts(
        self, features: FeatureMaps | Mapping[str, Tensor], size: tuple[int, int], read: Tensor | None = None
    ) -> Tensor:
        """Compute what R small networks read from the feature maps (readouts); their blurred mean is the map m.

        Args:
            features: as for `forward`.
            size: `(height, width)` of the pictures in pixels.
            read: weights of the channels in place of the model's own, for its fit.

        Returns:
            `(B, R, rows, columns)`.

        Raises:
            InputError: a feature map is missing or has another number of channels.
        """
        cells = cells_of(size)
        units_by_shape = self._units(features, self.read if read is None else read)
        # One at a time, as all of them would fill the memory.
        resized = (on_picture(units, features, shape, cells) for shape, units in units_by_shape.items())
        hidden = next(resized) + self.shift[:, None, None]
        for on_cells in resized:
            hidden.add_(on_cells)
        units_of_readout = self.mix.shape[-1]
        first_layer = F.relu_(hidden).flatten(2).unflatten(1, (-1, units_of_readout))
        second_layer = F.relu_(self.mix @ first_layer + self.mix_shift[..., None])
        readouts = self.out[:, None] @ second_layer
        return readouts[:, :, 0].unflatten(-1, cells)

    def _units(self, features: FeatureMaps | Mapping[str, Tensor], read: Tensor) -> dict[tuple[int, int], Tensor]:
        """Convolve each map, where the picture is, and sum the results of maps of one shape.

        Args:
            features: as for `forward`.
            read: weights of the channels of all maps, `(U, C)`.

        Returns:
            `(B, U, h, w)` by the shape of the maps, which are larger where the picture does not fill them.
        """
        maps = features.maps if isinstance(features, FeatureMaps) else features
        by_shape: dict[tuple[int, int], Tensor] = {}
        weights = read.split([*self.layers.values()], 1)
        for (name, channels), weight in zip(self.layers.items(), weights, strict=True):
            if name not in maps:
                raise InputError(f"features: expected the map {name!r}, got {', '.join(maps)}")
            layer = maps[name]
            check_shape(layer, f"features[{name!r}]", None, channels, None, None)
            shape = (int(layer.shape[-2]), int(layer.shape[-1]))
            rows, columns = sides_of(features, shape)
            part = layer[..., rows.first : rows.stop, columns.first : columns.stop].to(weight)
            # Before the interpolation, which is then of a few units and not of hundreds of channels.
            units = F.conv2d(part, weight[..., None, None])
            if shape in by_shape:
                by_shape[shape].add_(units)
            else:
                by_shape[shape] = units
        return by_shape

    def centre_bias(self, size: tuple[int, int]) -> Tensor:
        """Compute the weighted log density of the centre bias.

        Args:
            size: `(height, width)` of the picture in pixels.

        Returns:
            `(rows, columns)`.
        """
        centre = self.centre.to(self.read)[None, None]
        cells = F.interpolate(centre, cells_of(size), mode="bilinear", align_corners=False)[0, 0]
        return self.centre_weight * cells

    def given(
        self,
        terms: Mapping[str, Tensor],
        size: tuple[int, int],
        scanpath: Tensor,
        corner: tuple[int, int, int] = (0, 0, 1),
    ) -> dict[str, Tensor]:
        """Compute the terms given scanpaths `(B, n, 2)`: weighted map and centre bias, and the oculomotor biases.

        Args:
            terms: map and centre bias `(B, rows, columns)` or `(1, rows, columns)`.
            size: `(height, width)` of the picture in pixels.
            scanpath: as for `forward`.
            corner: first row, first column and step of the cells that are kept.

        Returns:
            The terms of `terms` with a scanpath.
        """
        height, width = size
        longer = max(size)
        path = (scanpath.to(self.read) + 0.5) / longer
        rows, columns = cells_of(size)
        top, left, step = corner
        # Centres of the cells, in longer sides of the picture as the path is.
        column = torch.arange(left, columns, step).to(path)
        row = torch.arange(top, rows, step).to(path)
        x = (column + 0.5) * (width / columns / longer)
        y = (row + 0.5) * (height / rows / longer)
        cells = (len(y), len(x))
        places = torch.stack([x.expand(cells), y[:, None].expand(cells)], -1).flatten(0, 1)

        fixations = (~path[..., 0].isnan()).sum(1)  # NaN stands for none
        gain_of_map, gain_of_centre = self.oculomotor.gains(fixations)[..., None, None].unbind(1)
        return {
            "map": gain_of_map * terms["map"][:, top::step, left::step],
            "centre bias": gain_of_centre * terms["centre bias"][:, top::step, left::step],
            "oculomotor biases": self.oculomotor(path, places).unflatten(-1, cells),
        }

    @torch.no_grad()
    def sample(
        self,
        terms: Mapping[str, Tensor],
        size: tuple[int, int],
        start: Tensor,
        fixations: int,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Sample scanpaths: each fixation from the density that is predicted from the fixations before it.

        Args:
            terms: `terms` of one picture without a scanpath.
            size: `(height, width)` of the picture in pixels.
            start: `(n, 2)`, first fixations in pixels of the picture.
            fixations: number of fixations of each scanpath, the first included.
            generator: random generator of the draws.

        Returns:
            `(n, fixations, 2)`, in pixels of the picture, anywhere in the drawn cells.

        >>> model = FixationDensity({"backbone8": 3})
        >>> terms = model.terms({"backbone8": torch.rand(1, 3, 6, 8)}, (60, 80))
        >>> model.sample(terms, (60, 80), torch.full((5, 2), 30.0), 4).shape
        torch.Size([5, 4, 2])
        """
        rows, columns = cells_of(size)
        cell_size = torch.tensor([size[1] / columns, size[0] / rows]).to(start)
        path = start[:, None]
        for _ in range(fixations - 1):
            log_density = torch.stack([*self.given(terms, size, path).values()]).sum(0)
            density = log_density.flatten(1).double().softmax(1)  # (n, rows · columns)
            cell = density.multinomial(1, generator=generator)[:, 0]
            corner = torch.stack([cell % columns, cell // columns], 1).to(start)
            within_cell = torch.rand(corner.shape, generator=generator).to(start)
            fixation = (corner + within_cell) * cell_size - 0.5
            path = torch.cat([path, fixation[:, None]], 1)
        return path

    def extra_repr(self) -> str:
        """Return the layers and the number of readouts for `repr`."""
        return f"layers={self.layers}, readouts={self.mix.shape[0]}, units={self.mix.shape[1]}"

    def _tensors(self) -> dict[str, Tensor]:
        """List the tensors that are saved; the weights of the convolutions are in half precision."""
        tensors = super()._tensors()
        return tensors | {name: tensors[name].to(_HALF) for name in ("read", "mix")}

    def _record(self) -> dict[str, object]:
        """List what a file holds beside tensors."""
        return {"layers": [[name, channels] for name, channels in self.layers.items()]}

    @classmethod
    def _restore(cls, record: JsonObject, tensors: dict[str, Tensor]) -> Self:
        """Make the model of a file."""
        readouts, units = tensors["mix"].shape[:2]
        model = cls(dict(record["layers"]), readouts=readouts, units=units, metadata=record["metadata"])
        expected = str(tuple(model.read.shape))
        check(tensors["read"].shape == model.read.shape, "read", expected, tuple(tensors["read"].shape))
        # Their sizes are those of the file.
        model.centre = tensors["centre"]
        model.duration = tensors["duration"]
        if "likeness.mean" in tensors:  # models of few pictures have none
            model.likeness = PictureLikeness(len(tensors["likeness.mean"]), len(tensors["likeness.variance"]))
        model.to(tensors["shift"].dtype)
        model.load_state_dict({name: value.to(tensors["shift"].dtype) for name, value in tensors.items()})
        return model


_read = cache(FixationDensity.from_pretrained)  # shipped files do not change


def shared_density(detector: Detector) -> FixationDensity:
    """Return a cached model of `FixationDensity.for_detector`, which callers must not change."""
    folder = FixationDensity.shipped
    path = folder / f"{detector.name}.safetensors"
    if not path.is_file():
        names = ", ".join(sorted(path.stem for path in folder.glob("*.safetensors")))
        model_name = detector.name if detector.name in WEIGHTS else "MODEL"  # a file has more than its name
        raise InputError(
            f"detector: a model of where people look is shipped for {names}, got {detector.name}; fit one to "
            f"fixations with `semfov fit {model_name} --gaze.fixations FILE --gaze.pictures FOLDER`"
        )
    model = _read(path)
    model.check_compatible(detector)
    return model


def density_for(detector: Detector, model: FixationDensity | str | PathLike[str] | None) -> FixationDensity:
    """Return the model for a detector: the shipped one, or a copy of the given one after a check.

    Args:
        detector: the detector.
        model: the model, or its file or folder; None for the one that is shipped.

    Returns:
        The model, on the processor.

    Raises:
        InputError: none is shipped for the detector, or the given one was fitted to another detector.
        DataError: its file is missing or damaged.
    """
    if model is None:
        return shared_density(detector)
    if isinstance(model, str | PathLike):
        model = FixationDensity.from_pretrained(model)
    expected = "a FixationDensity, or its file (FixationDensity.from_pretrained)"
    check(isinstance(model, FixationDensity), "model", expected, type(model).__name__)
    model.check_compatible(detector)
    return deepcopy(model).cpu()


def _size_of(features: FeatureMaps | Mapping[str, Tensor]) -> tuple[int, int]:
    """Find `(height, width)` of the picture of feature maps; of maps by name, that of the finest one."""
    if isinstance(features, FeatureMaps):
        width, height = features.placement.size
        return height, width
    sizes = [(int(maps.shape[-2]), int(maps.shape[-1])) for maps in features.values()]
    return max(sizes)


def cells_of(size: tuple[int, int]) -> tuple[int, int]:
    """Count rows and columns of cells of a picture of `(height, width)`, 52 along its longer side."""
    longer = max(size)
    rows, columns = (max(1, round(_CELLS * side / longer)) for side in size)
    return rows, columns


def blurred(maps: Tensor, sigma: Tensor) -> Tensor:
    """Blur maps by a Gaussian, whose weights also sum to 1 at the border.

    Args:
        maps: `(..., rows, columns)`.
        sigma: σ in cells, `()`.

    Returns:
        `(..., rows, columns)`.
    """
    along_rows = _blurring(maps.shape[-1], sigma)
    along_columns = _blurring(maps.shape[-2], sigma)
    return along_columns @ maps @ along_rows.mT


def _blurring(cells: int, sigma: Tensor) -> Tensor:
    """Make the matrix `(cells, cells)` that blurs a line of cells; differentiable in σ."""
    place = torch.arange(cells, device=sigma.device, dtype=sigma.dtype)
    squared_distance = (place[:, None] - place).square()
    # A softmax of -d² / 2σ² is a Gaussian whose weights sum to 1.
    return (squared_distance / (-2 * sigma.square())).softmax(-1)
