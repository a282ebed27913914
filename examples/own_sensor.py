"""Write your own sensor: a magnifying glass, which enlarges the part of the picture around the fixation.

Detectors miss objects that are small on their input. They find them more often enlarged, although enlarging adds no
detail. A magnifying glass moves pixels, so this sensor also maps the detector's boxes back to the picture.

Run it from a checkout: python -m examples.own_sensor
"""

from typing import Any

import torch
from torch import Tensor

import semfov
from semfov.data import Scene
from semfov.data.mosaics import Mosaics
from semfov.observation.matching import box_iou
from semfov.sensor import Sensor, glimpse, named_sensor


class MagnifyingGlass(Sensor):
    """Shows a window around the fixation, enlarged to the size of the canvas.

    Args:
        power: factor by which objects are enlarged.
    """

    def __init__(self, power: float = 2.0) -> None:
        super().__init__()
        self.power = power

    def open(self, canvas: Tensor, scale: Tensor) -> Tensor:
        """Return the canvas as it is; a sensor with widths in pixels would multiply them by `scale`."""
        return canvas

    def look(self, state: Tensor, gaze: Tensor) -> Tensor:
        """Enlarge the windows around fixations `(F, 2)` to views `(F, 3, h, w)`."""
        size = (state.shape[-1], state.shape[-2])
        windows = self.windows(state, gaze)
        return glimpse(state, windows[None], size, padding_mode="border")[0]

    def boxes_to_canvas(self, state: Tensor, gaze: Tensor, boxes: Tensor) -> Tensor:
        """Map boxes `(F, N, 4)` in the views to the canvas."""
        corner = self.windows(state, gaze)[:, None, :2]
        return boxes / self.power + torch.cat([corner, corner], -1)

    def windows(self, canvas: Tensor, gaze: Tensor) -> Tensor:
        """Compute the windows `(F, 4)` around fixations, moved to lie inside the canvas."""
        size = gaze.new_tensor([canvas.shape[-1], canvas.shape[-2]])
        centred = gaze + 0.5 - size / (2 * self.power)
        last = size * (1 - 1 / self.power)  # corner of the window that touches the right and the lower border
        corner = torch.minimum(centred.clamp(min=0), last)
        return torch.cat([corner, corner + size / self.power], -1)

    def settings(self) -> dict[str, Any]:
        """List the settings that the views depend on, by which stored looks and fitted models are told apart."""
        return {"kind": "magnifying glass", "power": self.power}


def main() -> None:
    """Count the objects of two mosaics, in which objects are small, that are recognised when they are fixated."""
    detector = semfov.load_detector("yolox-nano")
    mosaics = Mosaics(semfov.EmbeddedScenes(detector.classes, count=8), 2, 2, tile=(320, 240), count=2)
    sensors = {"published fovea": named_sensor("published"), "magnifying glass": MagnifyingGlass(power=3.0)}
    for name, sensor in sensors.items():
        eye = semfov.Eye(sensor, detector).eval().requires_grad_(False)
        scenes = [mosaics[index] for index in range(len(mosaics))]
        count = sum(recognised(eye, scene) for scene in scenes)
        objects = sum(len(scene.labels) for scene in scenes)
        print(f"{name}: {count} of {objects} objects are recognised when they are fixated")


def recognised(eye: semfov.Eye, scene: Scene) -> int:
    """Fixate every object of a scene, and count those that are recognised."""
    fixations = (scene.boxes[:, :2] + scene.boxes[:, 2:]) / 2 - 0.5
    looks = eye.look(eye.open(scene.image[None]), fixations)
    count = 0
    for number, label in enumerate(scene.labels.tolist()):
        seen = looks[number, looks.mask[number]]
        is_at_object = box_iou(seen.boxes, scene.boxes[number, None])[:, 0] >= 0.5
        is_of_class = seen.scores[:, label] >= 0.5
        count += bool((is_at_object & is_of_class).any())
    return count


if __name__ == "__main__":
    main()
