"""Registration of the environments with Gymnasium."""

IDS = {"search": "semfov/GazeSearch-v0", "exploration": "semfov/GazeExplore-v0"}


def register() -> None:
    """Register the environments by their names, unless they are registered already.

    >>> import gymnasium
    >>> register()
    >>> sorted(name for name in gymnasium.registry if name.startswith("semfov/"))
    ['semfov/GazeExplore-v0', 'semfov/GazeSearch-v0']
    """
    import gymnasium

    entries = {"search": ("make_search", "make_search_vector"), "exploration": ("make_explore", "make_explore_vector")}
    for task, name in IDS.items():
        one, many = (f"semfov.envs.making:{entry}" for entry in entries[task])
        if name not in gymnasium.registry:
            gymnasium.register(name, entry_point=one, vector_entry_point=many)
