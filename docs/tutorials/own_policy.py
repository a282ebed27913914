# %% [markdown]
# # Your policy
#
# A policy chooses the next fixation by an acquisition function, which gives every cell a value: the next fixation is the
# best cell not visited. The function of this tutorial keeps away from earlier fixations: it prefers the cell that is
# farthest from its closest fixation. It does not use the detections.

# %%
import matplotlib.pyplot as plt
import torch

import semfov
from semfov import policies, viz
from semfov.metrics.episodes import answers_of, right_cells

torch.set_grad_enabled(False)


class Farthest(semfov.acquisition.AcquisitionFunction):
    """Distance to the closest fixation so far; the definition of the class registers it under its name."""

    name = "keep-away"
    tasks = ("exploration",)

    def forward(self, belief: semfov.Belief, visited: torch.Tensor) -> torch.Tensor:
        """Values `(B, X·Y)`."""
        return belief.closest  # every belief keeps it


print(policies.policy_names("exploration"))

# %% [markdown]
# ## Put it into an agent
#
# An agent is an eye with a strategy for search and one for exploration. We take the eye and the map of the
# recommended agent, and combine them with the new policy.

# %% alt="The scanpath over a photograph of a market by the new policy, with the foveated views and the classes of the map"
recommended = semfov.ActivePerception.recommended()
search = recommended.searching.observer, recommended.searching.policy
mapper, closer = recommended.exploring.observer, recommended.exploring.policy
agents = {
    policy.name: semfov.ActivePerception(recommended.eye, search, (mapper, policy)).eval()
    for policy in (policies.Policy("keep-away"), closer, policies.Policy("random"))
}
scenes = semfov.EmbeddedScenes(recommended.classes[1:], count=4)
explored = agents["keep-away"].explore(scenes[1].image, start=0, shifts=6, min_gain=0)
viz.plot_episode(explored)

# %% [markdown]
# ## How good is it?
#
# We count the cells with objects that the map classifies correctly after each look, in four scenes, from two corners.
# The class of a cell is its most probable class without background.

# %%
looks = 8
right = {name: torch.zeros(looks + 1) for name in agents}
cells = 0
for index in range(len(scenes)):
    scene = scenes[index]
    answers = answers_of(scenes.annotation(index), explored.grid, len(recommended.classes))[:, 1:]
    for start in (0, 99):
        cells += int(answers.any(-1).sum())
        for name, agent in agents.items():
            path = agent.explore(scene.image, start=start, shifts=looks, min_gain=0)
            right[name] += right_cells(path.probabilities[..., 1:], answers).sum(-1)
share = {name: counts / cells for name, counts in right.items()}
print({name: f"{100 * counts[-1]:.0f} %" for name, counts in share.items()})

# %% alt="Share of correctly classified cells, by number of gaze shifts, for three policies"
figure, axis = plt.subplots(figsize=(6, 3.4), layout="compressed")
for name, counts in share.items():
    axis.plot(100 * counts.numpy(), "o-", label=name)
axis.set(xlabel="gaze shifts", ylabel="correctly classified cells (%)")
axis.grid(alpha=0.3)
_ = axis.legend()

# %% [markdown]
# Four photographs are too few for meaningful figures. To measure the policy, register it, name it in the settings of
# `eval.explore`, and run this study on many photographs. [Write your own policy](../guides/write_your_own_policy.md)
# shows these steps for a search policy.
