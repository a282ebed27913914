# %% [markdown]
# # Your detector
#
# The eye needs a detector: anything that returns boxes with a score for every class. A detector in an ONNX file needs
# no code at all ([detectors](../detectors.md)). This tutorial shows the other way, a detector written in twenty lines.
# It finds large and small coins in a drawn picture by thresholding, and has no weights.

# %%
import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.patches import Rectangle
from scipy import ndimage

import semfov
from semfov import viz
from semfov.detection import Candidates

torch.set_grad_enabled(False)


class CoinDetector(semfov.Detector):
    """Finds bright discs by a threshold; the score depends on their contrast, the class on their diameter."""

    def __init__(self) -> None:
        super().__init__("coins", ("large coin", "small coin"), (384, 303))

    def propose(self, canvas: torch.Tensor) -> Candidates:
        """Every disc on a canvas."""
        boxes, classes, objectness = [], [], []
        for picture in canvas:
            grey = picture.mean(0).cpu().double().numpy()
            regions, _ = ndimage.label(ndimage.binary_opening(grey > 0.5, iterations=3))
            edges = ndimage.gaussian_gradient_magnitude(grey, 1)
            places = ndimage.find_objects(regions)
            rims = [edges[place].max() for place in places]
            diameters = [max(down.stop - down.start, right.stop - right.start) for down, right in places]
            large = [1 / (1 + 2.718 ** ((42 - diameter) / 2)) for diameter in diameters]
            sides = [[right.start, down.start, right.stop, down.stop] for down, right in places]
            boxes.append(torch.tensor(sides).reshape(-1, 4))
            classes.append(torch.tensor([[p, 1 - p] for p in large]).reshape(-1, 2))
            objectness.append(torch.tensor(rims).mul(4).clamp(max=0.99))
        stack = [torch.nn.utils.rnn.pad_sequence(part, batch_first=True) for part in (boxes, classes, objectness)]
        return Candidates(*(part.to(canvas) for part in stack))


def draw_coins() -> torch.Tensor:
    """Draw coins of different sizes and brightness on a dark table, `(3, 303, 384)`."""
    random, down, right = np.random.default_rng(0), *np.mgrid[:303, :384]
    picture = 0.25 + 0.05 * random.standard_normal((303, 384))
    for number in range(24):
        x, y = 32 + number % 6 * 64 + random.uniform(-4, 4), 38 + number // 6 * 75 + random.uniform(-4, 4)
        distance = np.hypot(right - x, down - y)
        shade = random.uniform(0.65, 0.9) + 0.05 * np.cos(distance)
        picture = np.where(distance < random.choice([17, 26]), shade, picture)
    return torch.from_numpy(ndimage.gaussian_filter(picture, 0.7)).float().clamp(0, 1).expand(3, -1, -1)


image = draw_coins()
detector = CoinDetector().eval()
print(detector.classes, image.shape)


# %% alt="A drawing of coins: sharp all over, and seen from one fixation, with the boxes that the detector finds"
def show(axis, picture, seen, title):
    """Draw a picture with boxes: the colour is the class, the opacity the score."""
    axis.imshow(picture.permute(1, 2, 0).clamp(0, 1).numpy())
    for (x1, y1, x2, y2), scores in zip(seen.boxes.tolist(), seen.scores):
        label = int(scores[1:].argmax())
        colour = {0: "#E69F00", 1: "#56B4E9"}[label]
        place = (x1, y1), x2 - x1, y2 - y1
        axis.add_patch(Rectangle(*place, fill=False, edgecolor=colour, linewidth=2, alpha=float(scores[1:].max())))
    axis.set(title=title, xticks=[], yticks=[])


eye = semfov.Eye(semfov.Foveation(40.0), detector, reference=384.0).eval()
gaze = torch.tensor([[290.0, 60.0]])
view = eye.open(image[None])
sharp, foveal = detector(image[None])[0], eye.look(view, gaze)[0]
figure, axes = plt.subplots(1, 2, figsize=(9, 3.8), layout="compressed")
show(axes[0], image, sharp, f"sharp: {len(sharp.boxes)} coins")
show(axes[1], eye.foveated(view, gaze)[0], foveal, f"from (290, 60): {len(foveal.boxes)} coins")

# %% [markdown]
# ## How do its scores depend on the distance to the fovea?
#
# Blurred coins have soft rims and get lower scores. An observation model learns the distribution of the scores for each
# class and distance to the fovea. We take the detections in the sharp picture as the truth, look at random points, and
# fit the model.

# %%
from semfov.observation import match

edges = [0.1, 0.2, 0.3, 0.5]  # borders of the levels of distance, in longer sides of the picture
truth, labels = sharp.boxes, sharp.scores[:, 1:].argmax(-1) + 1
statistics = semfov.DirichletStatistics((3, len(edges) + 1), components=3)
grid = semfov.Grid(10, 8, (384, 303))
fixations = torch.rand(60, 2, generator=torch.Generator().manual_seed(0)) * torch.tensor([384.0, 303.0])
model = semfov.FovealObservationModel.identity(detector.classes, edges)
for fixation in fixations:
    seen = eye.look(view, fixation[None])[0]
    level = model.level(grid.box_distance(seen.boxes, fixation))
    statistics.update(seen.scores, (match(seen.boxes, truth, labels), level))
model.fit(statistics, minimum=1, prior=True, **eye.settings()).eval().requires_grad_(False)
print(int(statistics.count.sum()), "detections")

# %% alt="Expected scores of large coins, small coins and background, by level of distance to the fovea"
expected = model.expected_scores()
figure, axes = plt.subplots(1, 3, figsize=(9, 2.8), layout="compressed", sharey=True)
for axis, name, scores in zip(axes, ("background", *detector.classes), expected):
    for component, label in enumerate(("background", *detector.classes)):
        axis.plot(range(len(edges) + 1), scores[:, component].numpy(), "o-", label=f"score of {label}")
    axis.set(title=name, xlabel="level of distance")
axes[0].set(ylabel="expected score")
_ = axes[0].legend()

# %% [markdown]
# ## Search with it
#
# An agent is an eye with an observer and a policy. The observation model that we fitted gives the scores of a blurred
# coin the right weight.

# %% alt="The scanpath over the coins to a large one, with the foveated view and the probability of large coins at each fixation"
observer = semfov.observers.Semantic(3, model)
search, explore = semfov.policies.Policy("non-predictive"), semfov.policies.Policy("kl", model)
agent = semfov.ActivePerception(eye, (observer, search), (observer, explore), grid=(10, 8)).eval()
scanpath = agent.search(image, "large coin", start=79)
print(scanpath)
viz.plot_episode(scanpath)

# %% [markdown]
# For practical use, fit on thousands of photographs: `semfov fit` fits everything that the
# recommended agent needs ([your detector](../detectors.md#your-detector)).
#
# Next: [your policy](own_policy.py).
