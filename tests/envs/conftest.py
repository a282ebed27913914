"""Small worlds, shared by the tests of the environments: two embedded scenes, seen from a few cells."""

import pytest

from semfov.envs import open_scenery, open_zoom_scenery


@pytest.fixture(scope="session")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("envs") / "cache"


@pytest.fixture(scope="session")
def world(cache):
    """Options of small environments."""
    return {"count": 2, "grid": (5, 4), "shifts": 6, "starts": 3, "cache": cache}


@pytest.fixture(scope="session")
def sceneries(world):
    return {task: open_scenery(task, **world) for task in ("search", "exploration")}


@pytest.fixture(scope="session")
def zoom_scenery(cache):
    return open_zoom_scenery(mosaics=1, tiles=(3, 2), passes=6, cache=cache)
