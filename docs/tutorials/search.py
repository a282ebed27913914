# %% [markdown]
# # Search a photograph and read its decision
#
# An agent is an eye with an observer, which keeps a belief, and a policy, which chooses the next fixation. The
# recommended agent searches until it can decide whether the photograph holds the target.

# %%
import semfov
from semfov import viz

agent = semfov.ActivePerception.recommended()
photograph = semfov.example("beach")  # also a path, a Pillow image, a NumPy array or a tensor
scanpath = agent.search(photograph, "boat", start=99)
print(scanpath)

# %% alt="The scanpath over a photograph of a beach to a boat, with the foveated view and the belief at each fixation"
viz.plot_episode(scanpath)

# %% [markdown]
# The upper row shows the foveated views, sharp around the fixation, with their detections. The lower row shows the
# probability that a cell holds a boat. The search does not scan the picture in order; it looks where a boat is most
# probable.
#
# ## The decision
#
# A search has one of three outcomes. The outcome `found` comes with a cell and a box. Before the agent says `found`, it
# looks closely at the place: it enlarges a window around the box to the detector's input. The decision has two
# probabilities: that the photograph holds the target anywhere, and that the target is at this place.

# %%
decision = scanpath.decision
print(decision.outcome, f"{decision.probability:.2f} anywhere, {decision.place:.2f} in cell", decision.cell)
print("box", [round(side) for side in decision.box.tolist()])

# %%
scanpath.to_frame()[["look", "column", "row", "probability", "presence", "seen", "score"]].round(2)

# %% [markdown]
# `probability` is the probability of the target in the fixated cell, `presence` the probability that the photograph
# holds the target, and `seen` the class of the most confident detection.
#
# ## An absent target
#
# There is no cup on the beach. The agent gives up when no remaining cell is worth a look.

# %% alt="The scanpath of a search for a cup, which is not there, and the decision"
absent = agent.search(photograph, "cup", start=0)
print(absent)
viz.plot_scanpath(absent)

# %% [markdown]
# Save a scanpath with `scanpath.save("search.safetensors")`, or make an animation with `scanpath.animate("search.gif")`.
# A notebook shows a scanpath as an interactive page if it is the last value of a cell.
#
# Next: [your detector](own_detector.py). The [results](../results.md) show how decisions were measured on photographs.
