"""Invariant visual search (IVSN) as published: attention to what resembles a picture of the target."""

from os import PathLike
from typing import Self

import torch
from torch import Tensor, nn

from semfov.detection.placement import resize
from semfov.errors import DataError, check, check_pixels, check_shape

_MEAN, _DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


class IVSN(nn.Module):
    r"""The attention map of IVSN (Zhang, Feng, Ma, Lim, Zhao and Kreiman, 2018, "Finding any Waldo").

    .. math:: M(y) = \sum_c \phi_c(I)(y) \, \psi_c(T)

    φ are the features of the search image I after the last convolutions of VGG16. ψ are the features of the target's
    picture T after the pooling that follows; for a picture of 28 × 28 pixels they are one vector. The search image is
    correlated with this vector. The gaze goes from one maximum to the next, with inhibition of return. The network is
    VGG16 trained on ImageNet, and is not trained for the task. It sees the whole picture sharply;
    `eval.ivsn.attention.TemplateAttention` is its counterpart for foveal looks.

    Args:
        features: network that computes φ, such as `torchvision.models.vgg16().features` without its last pooling.
        pool: pooling that turns φ of a target into ψ.
        picture: side in pixels of the square to which the search image is resized.
        target: side in pixels of the square to which the target's picture is resized.

    Shape:
        - image: `(B, 3, H, W)`, RGB in [0, 1]; target: `(B, 3, h, w)`
        - output: `(B, 14, 14)` for 224 pixels

    Example::

        ivsn = IVSN.vgg16("vgg16_features.safetensors")  # or IVSN.vgg16(), which lets torchvision download them
        salient = semfov.saliency.cell_saliency(ivsn(image, picture_of_target), 10, 10, "max")
        acquisition = semfov.acquisition.Static(salient)
    """

    def __init__(self, features: nn.Module, pool: nn.Module, *, picture: int = 224, target: int = 28) -> None:
        super().__init__()
        check(min(picture, target) > 0, "picture, target", "positive numbers of pixels", (picture, target))
        self.features = features
        self.pool = pool
        self.picture, self.target = picture, target
        self.register_buffer("mean", torch.tensor(_MEAN)[:, None, None], persistent=False)
        self.register_buffer("deviation", torch.tensor(_DEVIATION)[:, None, None], persistent=False)

    @classmethod
    def vgg16(cls, weights: str | PathLike[str] | None = "torchvision") -> Self:
        """Make the model from torchvision's VGG16.

        Args:
            weights: a safetensors file with VGG16's `features.*` as torchvision names them; `torchvision` for those of
                ImageNet, which torchvision downloads (528 MB); None for random ones.

        Returns:
            The model in evaluation mode, without gradients for its weights.

        Raises:
            DataError: the file does not hold the weights of VGG16's features.
        """
        from torchvision.models import VGG16_Weights, vgg16

        if weights == "torchvision":
            network = vgg16(weights=VGG16_Weights.IMAGENET1K_V1).features
        else:
            network = vgg16(weights=None, init_weights=weights is None).features
        layers = list(network)
        for layer in layers:
            if isinstance(layer, nn.MaxPool2d):
                # Caffe's VGG16 rounds sizes up: five poolings leave 1 of 28 pixels; rounding down would leave 0.
                layer.ceil_mode = True
        made = cls(nn.Sequential(*layers[:-1]), layers[-1]).eval().requires_grad_(False)
        if weights not in (None, "torchvision"):
            made._read(weights)
        return made

    def forward(self, image: Tensor, target: Tensor) -> Tensor:
        """Attention to the target at every position of the image.

        Args:
            image: `(B, 3, H, W)`, RGB in [0, 1], the search images.
            target: `(B, 3, h, w)`, RGB in [0, 1], a picture of the target for each of them.

        Returns:
            `(B, 14, 14)` for a `picture` of 224 pixels.

        Raises:
            InputError: shapes or pixel values do not fit, or the target's features are more than one vector.
        """
        for name, pixels in (("image", image), ("target", target)):
            check_shape(pixels, name, None, 3, None, None)
            check_pixels(pixels, name)
        check(len(image) == len(target), "target", f"{len(image)} pictures, one for each image", len(target))
        kernel = self.pool(self.features(self._prepared(target, self.target)))
        check_shape(kernel, "target's features", None, None, 1, 1)
        return torch.einsum("bchw,bc->bhw", self.features(self._prepared(image, self.picture)), kernel[..., 0, 0])

    def _prepared(self, pixels: Tensor, side: int) -> Tensor:
        mean, deviation = self.get_buffer("mean").to(pixels), self.get_buffer("deviation").to(pixels)
        return (resize(pixels, (side, side)) - mean) / deviation

    def _read(self, weights: str | PathLike[str] | None) -> None:
        from safetensors import SafetensorError
        from safetensors.torch import load_file

        try:
            tensors = load_file(str(weights))
            features = {name.removeprefix("features."): value for name, value in tensors.items()}
            self.features.load_state_dict({name: features[name] for name in self.features.state_dict()})
        except (OSError, SafetensorError, KeyError, RuntimeError) as error:
            raise DataError(f"{weights}: expected the weights of VGG16's features ({error})") from None
