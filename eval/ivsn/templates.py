"""Class templates: the mean features that a detector computes at objects of each class, and attention by them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Self

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.detection.placement import Placement
from semfov.errors import check, check_finite, check_shape
from semfov.io.compatibility import check_classes
from semfov.io.pretrained import PretrainedForEye
from semfov.io.schema import CLASSES, Field, Schema


class ClassTemplates(PretrainedForEye):
    r"""Attention for every class: the similarity of the features at every position to the template of the class.

    .. math:: M_k(y) = \cos\bigl(\hat\phi(y) - \mu, T_k\bigr), \qquad T_k = \bar\phi_k - \mu, \qquad
              \hat\phi = \phi / \|\phi\|

    φ are a detector's features before its first head, :math:`\bar\phi_k` is the mean of :math:`\hat\phi` at the centres
    of objects of class k, and μ its mean over all positions. IVSN (Zhang, Feng, Ma, Lim, Zhao and Kreiman, 2018)
    correlates the features of a search image with those of a picture of the target. Here the average object of the
    class takes the place of that picture, and the network is the detector that searches. `eval.ivsn.fit` fits the
    templates.

    Args:
        templates: `(K, C)`, T.
        mean: `(C)`, μ.
        classes: names of the K classes.
        metadata: JSON values to keep with the model: `detector` (the settings of the detector that the templates were
            fitted for) and `counts`.

    Raises:
        InputError: the shapes do not fit together, or a template is not finite.

    >>> templates = ClassTemplates(torch.eye(2), torch.zeros(2), ["cup", "cat"])
    >>> templates(torch.tensor([3.0, 4.0]).view(1, 2, 1, 1)).flatten()
    tensor([0.6000, 0.8000])
    """

    kind: ClassVar[str] = "class-templates"
    title: ClassVar[str] = "class templates"
    shipped: ClassVar[Path] = Path(__file__).parent / "models"
    schema: ClassVar[Schema] = Schema(
        {"templates": Field(("K", "C"), low=-1e3, high=1e3), "mean": Field(("C",), low=-1e3, high=1e3)},
        {"classes": CLASSES},
    )
    templates: Tensor
    mean: Tensor

    def __init__(
        self, templates: Tensor, mean: Tensor, classes: Sequence[str], *, metadata: Mapping[str, Any] | None = None
    ) -> None:
        super().__init__()
        check_shape(mean, "mean", None)
        check_shape(templates, "templates", len(classes), len(mean))
        check_finite(templates, "templates")
        self.classes = tuple(classes)
        self.metadata = dict(metadata or {})
        self.register_buffer("templates", templates.detach().clone())
        self.register_buffer("mean", mean.detach().clone())

    def forward(self, features: Tensor) -> Tensor:
        """Compare the features at every position with the template of every class.

        Args:
            features: `(B, C, h, w)`, of the detector.

        Returns:
            `(B, K, h, w)`, M, cosines from -1 to 1.

        Raises:
            InputError: the features have another number of channels than the templates.
        """
        check_shape(features, "features", None, len(self.mean), None, None)
        centred = unit(features) - self.mean.to(features)[:, None, None]
        return torch.einsum("kc,bchw->bkhw", F.normalize(self.templates.to(features), dim=-1), unit(centred))

    def check_eye(self, settings: Mapping[str, Any], classes: Sequence[str]) -> None:
        """Raise an error unless the templates were fitted for this eye's detector and classes.

        Args:
            settings: settings of the eye (`Eye.settings`).
            classes: names of its classes.

        Raises:
            InputError: the detector or the classes differ.
        """
        check_classes(self.classes, classes, self.title)
        self.check_compatible(settings)

    def _record(self) -> dict[str, Any]:
        """Return the names of the classes."""
        return {"classes": self.classes}

    @classmethod
    def _restore(cls, record: Mapping[str, Any], tensors: dict[str, Tensor]) -> Self:
        """Return the templates from a file's record and tensors."""
        return cls(tensors["templates"], tensors["mean"], record["classes"], metadata=record["metadata"])


def unit(features: Tensor) -> Tensor:
    """Scale features `(B, C, h, w)` to length 1 at every position."""
    return F.normalize(features, dim=1)


def at_points(maps: Tensor, points: Tensor, placement: Placement, canvas: tuple[int, int]) -> Tensor:
    """Read maps that cover a canvas at points of the image, by bilinear interpolation.

    Shapes: maps `(B, K, h, w)`, points `(P, 2)`, canvas `(width, height)` → `(B, K, P)`.
    """
    check(min(canvas) > 0, "canvas", "a positive width and height", canvas)
    share = (placement.points_to_canvas(points.to(maps)) + 0.5) / maps.new_tensor(canvas)
    where = (2 * share - 1).expand(len(maps), 1, -1, -1)
    return F.grid_sample(maps, where, padding_mode="border", align_corners=False)[:, :, 0]
