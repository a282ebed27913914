"""The names of the environments."""

IDS = {"search": "semfov/GazeSearch-v0", "exploration": "semfov/GazeExplore-v0"}


def register() -> None:
    """Register the environments, unless they are."""
    import gymnasium

    entries = {"search": ("make_search", "make_search_vector"), "exploration": ("make_explore", "make_explore_vector")}
    for task, name in IDS.items():
        one, many = (f"semfov.envs.making:{entry}" for entry in entries[task])
        if name not in gymnasium.registry:
            gymnasium.register(name, entry_point=one, vector_entry_point=many)
