"""Modules whose state includes their settings, so that a state with other settings raises an error."""

import json
from collections.abc import Mapping
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn

from semfov.errors import InputError, check_where_to, type_of

EXTRA_STATE = "_extra_state"
"""Name of the settings of a module in its state."""


class MovableModule(nn.Module):
    """Base of modules whose errors for an invalid device name the argument."""

    def to(self, *arguments: Any, **options: Any) -> Self:
        """Move or convert the module, as `torch.nn.Module.to` does; what is no device is refused."""
        check_where_to(*arguments, **options)
        return super().to(*arguments, **options)


class StatedModule(MovableModule):
    """Base of modules whose settings, as bytes of JSON, are in their state; one without them is loaded, too.

    Settings that a module has by construction are compared where a state is loaded. Values that a fit has chosen beside
    parameters, such as thresholds, are loaded with it.
    """

    _setting_names: ClassVar[tuple[str, ...]] = ()
    """Names of the settings that are no parameters."""

    def _stated(self) -> dict[str, object]:
        """List the settings that are no parameters, as JSON values."""
        return {name: getattr(self, name) for name in self._setting_names}

    def _fitted_values(self) -> dict[str, object]:
        """List the values that a fit has chosen beside parameters, as JSON values."""
        return {}

    def _load_fitted_values(self, values: Mapping[str, Any]) -> None:
        """Take those of a state."""

    def get_extra_state(self) -> Tensor:
        """Write the settings and the values of a fit as bytes of JSON."""
        values = {**self._stated(), **self._fitted_values()}
        return torch.frombuffer(bytearray(json.dumps(values).encode()), dtype=torch.uint8)

    def set_extra_state(self, state: Tensor) -> None:
        """Refuse the state of a module with other settings, and take the values of its fit."""
        theirs = json.loads(bytes(state.tolist()))
        for name, value in json.loads(json.dumps(self._stated())).items():  # as JSON, where tuples are lists
            if theirs.get(name, value) != value:
                raise InputError(
                    f"state_dict: expected the state of {type_of(self)} with {name} {value!r:.200}, got one "
                    f"with {theirs[name]!r:.200}; make the module with these settings"
                )
        self._load_fitted_values(theirs)

    def _load_from_state_dict(
        self,
        state_dict: dict[str, Tensor],
        prefix: str,
        local_metadata: Mapping[str, object],
        strict: bool,
        missing_keys: list[str],
        unexpected_keys: list[str],
        error_msgs: list[str],
    ) -> None:
        """Load after a look at the settings, which may be missing."""
        key = prefix + EXTRA_STATE
        # Before the tensors, so that the message names the setting and not the shapes that follow from it.
        if key in state_dict:
            self.set_extra_state(state_dict[key])
        super()._load_from_state_dict(
            state_dict, prefix, local_metadata, strict, missing_keys, unexpected_keys, error_msgs
        )
        # Files of models have their settings in the record.
        if key in missing_keys:
            missing_keys.remove(key)


def without_settings(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Select the parameters and buffers of a `state_dict`.

    Args:
        state: the state.

    Returns:
        The state without the settings of modules.
    """
    return {name: tensor for name, tensor in state.items() if name.rpartition(".")[2] != EXTRA_STATE}
