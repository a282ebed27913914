"""The published YOLOv3 networks as Darknet sections (Redmon and Farhadi 2018)."""

from collections.abc import Callable

from semfov.detection.darknet_config import Section

ANCHORS = "10,13, 16,30, 33,23, 30,61, 62,45, 59,119, 116,90, 156,198, 373,326"
TINY_ANCHORS = "10,14, 23,27, 37,58, 81,82, 135,169, 344,319"


def yolov3(classes: int = 80) -> list[Section]:
    """YOLOv3: Darknet-53 and heads at strides 32, 16 and 8 on a 416 x 416 input; 75 convolutions."""
    return _yolov3(416, classes, [])


def yolov3_spp(classes: int = 80) -> list[Section]:
    """YOLOv3-spp: YOLOv3 with parallel max pools of sizes 5, 9 and 13 before the first head, at 608 x 608."""
    pyramid = [
        _pool(5, 1),
        _route(-2),
        _pool(9, 1),
        _route(-4),
        _pool(13, 1),
        _route(-1, -3, -5, -6),
        _convolution(512, 1),
    ]
    return _yolov3(608, classes, pyramid)


def yolov3_tiny(classes: int = 80) -> list[Section]:
    """YOLOv3-tiny: seven convolutions with max pools in between, heads at strides 32 and 16, at 416 x 416.

    The second head has the anchors 1, 2, 3. Some cfgs have 0, 1, 2, but the published weights fit 1, 2, 3.

    Args:
        classes: number of classes.

    Returns:
        The sections of the cfg.
    """
    backbone = []
    for filters in (16, 32, 64, 128, 256):
        backbone += [_convolution(filters, 3), _pool(2, 2)]
    coarse = [
        _convolution(512, 3),
        _pool(2, 1),
        _convolution(1024, 3),
        _convolution(256, 1),
        _convolution(512, 3),
        *_head("3,4,5", TINY_ANCHORS, classes),
    ]
    fine = [_route(-4), _convolution(128, 1), _upsample(), _route(-1, 8), _convolution(256, 3)]
    return [_net(416), *backbone, *coarse, *fine, *_head("1,2,3", TINY_ANCHORS, classes)]


ARCHITECTURES: dict[str, Callable[..., list[Section]]] = {
    "yolov3": yolov3,
    "yolov3-tiny": yolov3_tiny,
    "yolov3-spp": yolov3_spp,
}


def _yolov3(size: int, classes: int, pyramid: list[Section]) -> list[Section]:
    sections = [_net(size), _convolution(32, 3)]
    ends = []
    for filters, blocks in ((64, 1), (128, 2), (256, 8), (512, 8), (1024, 4)):
        sections.append(_convolution(filters, 3, stride=2))
        sections += [_convolution(filters // 2, 1), _convolution(filters, 3), _shortcut()] * blocks
        ends.append(len(sections) - 2)  # minus 2, because [net] is not a layer
    for width, mask, lateral in ((512, "6,7,8", None), (256, "3,4,5", ends[3]), (128, "0,1,2", ends[2])):
        if lateral is not None:
            sections += [_route(-4), _convolution(width, 1), _upsample(), _route(-1, lateral)]
        sections += [_convolution(width, 1), _convolution(2 * width, 3), _convolution(width, 1)]
        sections += pyramid if lateral is None else []
        sections += [_convolution(2 * width, 3), _convolution(width, 1), _convolution(2 * width, 3)]
        sections += _head(mask, ANCHORS, classes)
    return sections


def _section(kind: str, **options: int | str) -> Section:
    return Section(kind, {key: str(value) for key, value in options.items()}, "built-in cfg")


def _net(size: int) -> Section:
    return _section("net", width=size, height=size, channels=3)


def _convolution(filters: int, size: int, stride: int = 1) -> Section:
    return _section(
        "convolutional", batch_normalize=1, filters=filters, size=size, stride=stride, pad=1, activation="leaky"
    )


def _pool(size: int, stride: int) -> Section:
    return _section("maxpool", size=size, stride=stride)


def _route(*layers: int) -> Section:
    return _section("route", layers=",".join(map(str, layers)))


def _shortcut() -> Section:
    return _section("shortcut", **{"from": -3}, activation="linear")


def _upsample() -> Section:
    return _section("upsample", stride=2)


def _head(mask: str, anchors: str, classes: int) -> list[Section]:
    filters = len(mask.split(",")) * (5 + classes)
    maps = _section("convolutional", filters=filters, size=1, stride=1, pad=1, activation="linear")
    return [maps, _section("yolo", mask=mask, anchors=anchors, classes=classes)]
