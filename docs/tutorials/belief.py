# %% [markdown]
# # A belief in ten lines
#
# A detector is often wrong in blurred parts of a picture, and its scores are not calibrated probabilities. A belief
# gathers the detections from several fixations in a Dirichlet distribution over the classes for every cell of a grid.
# This tutorial computes a belief step by step, and then shows the module that does the same.

# %%
import matplotlib.pyplot as plt
import torch

import semfov
from semfov.sensor import named_sensor

torch.set_grad_enabled(False)
detector = semfov.load_detector("yolox-nano")
model = semfov.FovealObservationModel.from_pretrained("yolox-nano")
eye = semfov.Eye(named_sensor("gradual"), detector).eval()

scene = semfov.EmbeddedScenes(detector.classes)[4]  # a photograph that comes with semfov: a man, horses and a dog
view = eye.open(scene.image[None])
grid = semfov.Grid(10, 10, scene.size)
fixations = (scene.boxes[:, :2] + scene.boxes[:, 2:]) / 2 - 0.5  # one on each of its four objects

# %% [markdown]
# ## The views

# %% alt="Four foveated views of the same photograph of a farm, each sharp around its fixation"
figure, axes = plt.subplots(1, 4, figsize=(12, 2.6), layout="compressed")
for axis, picture, (x, y) in zip(axes, eye.foveated(view, fixations), fixations.tolist()):
    axis.imshow(picture.permute(1, 2, 0).clamp(0, 1).numpy())
    axis.set(title=f"from ({x:.0f}, {y:.0f})", xticks=[], yticks=[])

# %% [markdown]
# ## The ten lines
#
# A detection has scores for background and for all classes, which sum to 1. The observation model describes the
# distribution of these scores for each class and distance to the fovea, and turns scores into likelihoods of the
# classes. Kaplan's rule fuses the likelihoods into the Dirichlets of the cells that the detection's box overlaps. If
# several boxes overlap a cell, the most confident detection is fused first.

# %%
beta = torch.full((len(grid), 81), 0.5)  # a flat prior for every cell
beliefs = []
for fixation in fixations:
    seen = eye.look(view, fixation[None])[0]
    distance = grid.box_distance(seen.boxes, fixation)
    likelihood = model.calibrate(seen.scores, distance)
    for box, footprint in enumerate(grid.footprint(seen.boxes)):
        beta[footprint] = semfov.fusion.kaplan(beta[footprint], likelihood[box].expand(int(footprint.sum()), -1))
    beliefs.append(beta.clone())

# %% [markdown]
# The mean of a cell's Dirichlet gives the cell's class probabilities. The figure shows the probability of a person
# after each look. A flat prior of 0.5 for each of 81 classes weighs as much as forty looks, so the probability rises
# slowly. What matters is which class has the largest probability.

# %% alt="The photograph in grey with the probability of a person in each cell, after each of four looks"
person = detector.classes.index("person") + 1  # 0 is background
maps = torch.stack([belief[:, person] / belief.sum(-1) for belief in beliefs]).reshape(-1, 10, 10)
figure, axes = plt.subplots(1, 4, figsize=(12, 2.8), layout="compressed")
for number, (axis, probability) in enumerate(zip(axes, maps), start=1):
    axis.imshow(scene.image.mean(0).numpy(), cmap="gray", extent=(0, *scene.size, 0))
    strength = (0.9 * (probability / maps.max()).sqrt()).numpy()
    drawn = axis.imshow(
        probability.numpy(), cmap="plasma", alpha=strength, vmin=0, vmax=float(maps.max()), extent=(0, *scene.size, 0)
    )
    axis.plot(*fixations[:number].T.numpy(), ".", color="white", markeredgecolor="black", markersize=10)
    axis.set(title=f"person, look {number}", xticks=[], yticks=[])
_ = figure.colorbar(drawn, ax=axes, label="probability")

# %%
cells = grid.cell_of(fixations)
leaders = beliefs[-1][cells, 1:].argmax(-1)
for label, leader in zip(scene.labels.tolist(), leaders.tolist()):
    print(f"true class: {detector.classes[label - 1]}; most probable class: {detector.classes[leader]}")

# %% [markdown]
# ## The module that does the same
#
# `semfov.observers.Semantic` computes the same belief, to the same numbers, for batches of episodes, and for all
# detections of a look at once.

# %%
observer = semfov.observers.Semantic(81, model)
belief = observer.start(1, grid, fixations)
for fixation in fixations:
    belief = observer(belief, eye.look(view, fixation[None]), fixation[None], grid)
torch.testing.assert_close(belief.beta[0], beta, rtol=1e-3, atol=1e-3)
print("largest difference", float((belief.beta[0] - beta).abs().max()))

# %% [markdown]
# Next: [search a photograph](search.py) with a learned belief. See also the guide to [beliefs](../guides/belief.md).
