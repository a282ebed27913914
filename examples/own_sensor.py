"""A sensor of your own: a magnifying glass, which shows a part of the picture around the fixation enlarged.

Detectors miss what is small on their input. Enlarged it is found more often, though enlarging adds no detail. What a
magnifying glass shows lies elsewhere than in the picture, so the sensor also leads the detector's boxes back.

Run it from a checkout: python -m examples.own_sensor
"""

from typing import Any

import torch
from torch import Tensor

import semfov
from semfov.data.mosaics import Mosaics
from semfov.observation.matching import box_iou
from semfov.sensor import Sensor, glimpse, named_sensor


class MagnifyingGlass(Sensor):
    """Shows a window around the fixation, enlarged to the size of the canvas.

    Args:
        power: how many times things look larger.
    """

    def __init__(self, power: float = 2.0) -> None:
        super().__init__()
        self.power = power

    def open(self, canvas: Tensor, scale: Tensor) -> Tensor:
        """Nothing to prepare; a sensor with widths in pixels would multiply them by `scale`."""
        return canvas

    def look(self, state: Tensor, gaze: Tensor) -> Tensor:
        """The windows `(F, 3, h, w)` around fixations `(F, 2)`."""
        size = state.shape[-1], state.shape[-2]
        return glimpse(state, self.windows(state, gaze)[None], size, padding_mode="border")[0]

    def boxes_to_canvas(self, state: Tensor, gaze: Tensor, boxes: Tensor) -> Tensor:
        """Boxes `(F, N, 4)` seen through the glass, as boxes on the canvas."""
        corner = self.windows(state, gaze)[:, None, :2]
        return boxes / self.power + torch.cat([corner, corner], -1)

    def windows(self, canvas: Tensor, gaze: Tensor) -> Tensor:
        """What is shown of the canvas, `(F, 4)`: not beyond its borders, as far as the fixation allows."""
        size = gaze.new_tensor([canvas.shape[-1], canvas.shape[-2]])
        corner = torch.minimum((gaze + 0.5 - size / (2 * self.power)).clamp(min=0), size * (1 - 1 / self.power))
        return torch.cat([corner, corner + size / self.power], -1)

    def settings(self) -> dict[str, Any]:
        """What the views depend on: stored looks and fitted models are kept apart by it."""
        return {"kind": "magnifying glass", "power": self.power}


def main() -> None:
    """Fixate every object of two mosaics of embedded scenes, in which all are small, and count those that are named."""
    detector = semfov.load_detector("yolov3-tiny")
    mosaics = Mosaics(semfov.EmbeddedScenes(detector.classes, count=8), 2, 2, tile=(320, 240), count=2)
    sensors = {"published fovea": named_sensor("published"), "magnifying glass": MagnifyingGlass(power=3.0)}
    for name, sensor in sensors.items():
        eye = semfov.Eye(sensor, detector).eval().requires_grad_(False)
        named = objects = 0
        for scene in (mosaics[index] for index in range(len(mosaics))):
            fixations = (scene.boxes[:, :2] + scene.boxes[:, 2:]) / 2 - 0.5
            seen = eye.look(eye.open(scene.image[None]), fixations)
            for look, label in enumerate(scene.labels.tolist()):
                here = box_iou(seen.boxes[look], scene.boxes[look, None])[:, 0] >= 0.5
                named += bool((here & seen.mask[look] & (seen.scores[look, :, label] >= 0.5)).any())
            objects += len(scene.labels)
        print(f"{name}: {named} of {objects} objects are named when they are fixated")


if __name__ == "__main__":
    main()
