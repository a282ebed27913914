"""A policy of your own: look where the target is most probable, but not beside what was fixated already.

The fovea has seen the surroundings of a fixation, too. Inhibition of return that is as wide as the fovea therefore goes
to places that are still blurred, as the gaze of people does (Klein, 2000).

Run it from a checkout: python -m examples.own_policy
"""

import torch
from torch import Tensor

import semfov
from semfov import policies
from semfov.sensor import named_sensor


class InhibitedPosterior(semfov.acquisition.AcquisitionFunction):
    r"""Posterior of the target times one minus a Gaussian of the distance to the closest fixation so far.

    .. math:: a(x) = P(C^x = t) \left(1 - \exp\left(-\frac{d(x)^2}{2 w^2}\right)\right)
    """

    def __init__(self, target: int | Tensor, width: float) -> None:
        super().__init__()
        self.target = target
        self.width = width

    def forward(self, belief: semfov.Belief, visited: Tensor) -> Tensor:
        """Values `(B, X·Y)`."""
        inhibition = torch.exp(-belief.closest.square() / (2 * self.width**2))
        return belief.probability(self.target) * (1 - inhibition)


class WideInhibition(policies.Policy):
    """Search by `InhibitedPosterior`; the definition of the class registers it under its name.

    Args:
        width: w in longer sides of the image.
    """

    name = "wide-inhibition"
    tasks = ("search",)

    def __init__(self, width: float = 0.1) -> None:
        super().__init__()
        self.width = width

    def forward(self, target: int | Tensor | None, grid: semfov.Grid) -> semfov.acquisition.AcquisitionFunction:
        """The acquisition function for a target on a grid."""
        return InhibitedPosterior(policies.wanted(target, self.name), self.width)


def main() -> None:
    """Search embedded scenes for everything in them, without the inhibition and with it."""
    detector = semfov.load_detector("yolov3-tiny")
    eye = semfov.Eye(named_sensor("published"), detector).eval().requires_grad_(False)
    observer = semfov.observers.Semantic(len(detector.classes) + 1)
    scenes = semfov.EmbeddedScenes(detector.classes, count=4)
    for name in ("non-predictive", "wide-inhibition"):
        policy = policies.named_policy(name, "search")  # or WideInhibition(width=0.15)
        agent = semfov.ActivePerception(eye, search=(observer, policy), explore=(observer, policies.Random()))
        shifts = []
        for index in range(len(scenes)):
            scene = scenes[index]
            for target in scenes.targets(index):
                boxes = scene.boxes[scene.labels == target]
                shifts += [agent.search(scene.image, target, start=start, boxes=boxes).shifts for start in (0, 99)]
        print(f"{name}: {sum(shifts) / len(shifts):.1f} gaze shifts on average, {len(shifts)} searches")


if __name__ == "__main__":
    main()
