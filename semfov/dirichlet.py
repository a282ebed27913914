"""The Dirichlet distribution (`semfov.observation.dirichlet`)."""

from semfov.observation.dirichlet import *  # noqa: F403
from semfov.observation.dirichlet import __all__  # noqa: F401 (the same public names)
