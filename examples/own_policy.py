"""Write your own policy: look where the target is most probable, but not close to earlier fixations.

The fovea also shows the surroundings of a fixation sharply. Inhibition of return that is as wide as the fovea directs
the gaze to places that are still blurred. People's gaze shows inhibition of return as well (Klein, 2000).

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

    Args:
        target: class t to search for.
        width: w in units of the image's longer side.
    """

    name = "wide-inhibition"
    tasks = ("search",)

    def __init__(self, target: int | Tensor, width: float = 0.1) -> None:
        super().__init__()
        self.target = target
        self.width = width

    def forward(self, belief: semfov.Belief, visited: Tensor) -> Tensor:
        """Compute the values of all cells, `(B, X·Y)`."""
        inhibition = torch.exp(-belief.closest.square() / (2 * self.width**2))
        return belief.probability(self.target) * (1 - inhibition)


def main() -> None:
    """Search embedded scenes without the wide inhibition and with it."""
    detector = semfov.load_detector("yolox-nano")
    eye = semfov.Eye(named_sensor("published"), detector).eval().requires_grad_(False)
    observer = semfov.observers.Semantic(len(detector.classes) + 1)
    scenes = semfov.EmbeddedScenes(detector.classes, count=4)
    for name in ("non-predictive", "wide-inhibition"):
        policy = policies.Policy(name)  # or policies.Policy("wide-inhibition", width=0.15)
        agent = semfov.ActivePerception(eye, search=(observer, policy), explore=(observer, policies.Policy("random")))
        shifts = gaze_shifts(agent, scenes)
        print(f"{name}: {sum(shifts) / len(shifts):.1f} gaze shifts on average, {len(shifts)} searches")


def gaze_shifts(agent: semfov.ActivePerception, scenes: semfov.EmbeddedScenes) -> list[int]:
    """Search scenes for all their classes, each from the first and from the last cell; returns the gaze shifts."""
    shifts = []
    for index in range(len(scenes)):
        scene = scenes[index]
        for target in scenes.targets(index):
            boxes = scene.boxes[scene.labels == target]
            for start in (0, 99):
                scanpath = agent.search(scene.image, target, start=start, boxes=boxes)
                shifts.append(len(scanpath) - 1)
    return shifts


if __name__ == "__main__":
    main()
