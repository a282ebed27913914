# %% [markdown]
# # Search a photograph and read its decision
#
# An agent is an eye with a way to believe and a way to choose where to look next. The recommended one searches until
# it can say whether the photograph holds what it looks for.

# %%
import semfov
from semfov import viz

agent = semfov.ActivePerception.recommended("yolov3-tiny")
scene = semfov.EmbeddedScenes(agent.classes[1:])[6]
# A path, or a picture of Pillow's, NumPy's or torch's, will do, too.
scanpath = agent.search(scene.image, "cat", start=99)
print(scanpath)

# %% alt="The gaze's way over a collage of photographs to the cat, beside what the eye saw and believed at each fixation"
viz.plot_episode(scanpath)

# %% [markdown]
# Above: what the eye was shown, sharp around the fixation, with what was detected there. Below: the probability that
# a cell holds the cat. The search did not go through the picture in order; it went where a cat was most probable.
#
# ## The decision
#
# A search ends in one of three outcomes. `found` comes with a cell and a box. The probability is that of the
# photograph holding the target at all, over all cells.

# %%
decision = scanpath.decision
print(decision.outcome, f"{decision.probability:.2f}", "in cell", decision.cell)
print("box", [round(side) for side in decision.box.tolist()])

# %%
scanpath.to_frame()[["fixation", "column", "row", "probability", "presence", "seen", "score"]].round(2)

# %% [markdown]
# `probability` is that of the fixated cell, `presence` that of the whole photograph, `seen` the most confident
# detection.
#
# ## What is not there
#
# There is no cup in the scene. The agent gives up when no cell is left that is worth a look.

# %% alt="The gaze's way in search of a cup, which is not there, and the decision"
absent = agent.search(scene.image, "cup", start=0)
print(absent)
viz.plot_scanpath(absent)

# %% [markdown]
# ## What a look costs
#
# In place of thresholds a look may have a price, in right decisions. The search goes on as long as looking is
# expected to be worth its price, and then says what is rather the case than not.

# %%
for price in (0.001, 0.01, 0.1):
    priced = agent.search(scene.image, "cup", start=0, price=price)
    print(f"price {price}: {priced.shifts} gaze shifts, {priced.decision.outcome}, {priced.decision.probability:.2f}")

# %% [markdown]
# Save a scanpath with `scanpath.save("search.safetensors")`, make a film with `scanpath.animate("search.gif")`, or
# let it be the last value of a notebook's cell: it then shows itself as a page to step through.
#
# Next: [your detector](own_detector.py), and how decisions were measured on photographs in the
# [results](../results.md).
