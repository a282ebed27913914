# %% [markdown]
# # Foveate
#
# An eye is sharp only around its fixation. `semfov.foveate` shows a picture as such an eye sees it: it weights the
# bands of a Laplacian pyramid with Gaussian windows around the fixation, and collapses the pyramid again.

# %%
import matplotlib.pyplot as plt
import torch

import semfov

image = semfov.example("lifeboat")  # a photograph that comes with semfov; (3, 332, 480), RGB in [0, 1]
gaze = [(200, 95), (430, 215)]  # the man who stands, and the wheel
views = semfov.foveate(image, gaze, sigma=50, growth=1)
print(views.shape)


# %% alt="Three times the same photograph of a lifeboat and its crew: sharp all over, sharp on the man who stands, sharp on a wheel"
def show(pictures, titles, points=()):
    """Pictures side by side, with a cross at each point that is given."""
    figure, axes = plt.subplots(1, len(pictures), figsize=(4 * len(pictures), 3.2), layout="compressed")
    for axis, picture, title in zip(axes, pictures, titles):
        axis.imshow(picture.permute(1, 2, 0).clamp(0, 1).numpy())
        axis.set(title=title, xticks=[], yticks=[])
    for axis, (x, y) in zip(axes[-len(points) :], points):
        axis.plot(x, y, "+", color="white", markersize=12)


show([image, *views], ["photograph", "looking at the man who stands", "looking at the wheel"], gaze)

# %% [markdown]
# ## How acuity falls off
#
# `sigma` is the width of the fovea in pixels. `growth` is the ratio of the window widths of successive bands, from fine
# to coarse. With `growth=1`, as published, all bands share one window: a sharp disc on a blurred picture. With
# `growth=2` acuity falls off gradually.

# %% alt="The lifeboat with a fovea of 50 pixels: with growth 1 a sharp disc on a blurred picture, with growth 2 a gradual fall-off"
kinds = {"growth 1, σ = 50": (50, 1.0), "growth 2, σ = 50": (50, 2.0), "growth 2, σ = 20": (20, 2.0)}
pictures = [semfov.foveate(image, gaze[0], sigma=sigma, growth=growth) for sigma, growth in kinds.values()]
show(pictures, list(kinds))

# %% [markdown]
# ## Another look is cheap
#
# The pyramid does not depend on the fixation, so you can build it once for any number of looks. The module
# `semfov.Foveation` keeps the settings.

# %%
sensor = semfov.Foveation(50.0, growth=1.0)
bands = sensor.pyramid(image[None])  # once for the photograph
fixations = torch.rand(1, 8, 2) * torch.tensor([480, 332])
print(sensor(bands, fixations).shape)  # eight looks

# %% [markdown]
# ## Recover an unknown fixation
#
# Foveation is differentiable in the picture, in σ and in the fixation. So gradient descent can find the unknown
# fixation of a given view. We start at the centre and move the gaze until our view equals the given view.

# %%
unknown = torch.tensor([300.0, 120.0])
seen = sensor(bands, unknown)

guess = torch.tensor([240.0, 166.0], requires_grad=True)
optimizer = torch.optim.Adam([guess], lr=10.0)
path, errors = [], []
for _ in range(60):
    error = (sensor(bands, guess) - seen).square().mean()
    optimizer.zero_grad()
    error.backward()
    path.append(guess.detach().clone())
    errors.append(error.item())
    optimizer.step()
print(f"guess ({guess[0]:.1f}, {guess[1]:.1f}), truth ({unknown[0]:.1f}, {unknown[1]:.1f})")

# %% alt="The path of the guess over the foveated lifeboat, from the centre to the true fixation, and the error falling with the steps"
figure, (left, right) = plt.subplots(1, 2, figsize=(8.5, 3.8), layout="compressed")
left.imshow(seen[0].permute(1, 2, 0).clamp(0, 1).numpy())
left.plot(*torch.stack(path).T.numpy(), ".-", color="white", markersize=4, linewidth=1)
left.plot(*unknown.tolist(), "x", color="#E69F00", markersize=12, markeredgewidth=3)
left.set(title="the view that we were shown, and our way to it", xticks=[], yticks=[])
right.semilogy(errors)
right.set(title="difference of the views", xlabel="step", ylabel="mean squared error")
right.grid(alpha=0.3)

# %% [markdown]
# Next: [a belief in ten lines](belief.py). See also the guide to [sensors](../guides/sensor.md). The formulas are in the
# reference of `semfov.foveate`.
