"""What the keys of a rotary joint are called on a linear axis: rad becomes m, N m becomes N, inertia becomes mass.

Inside the product both kinds use the rotary names (see ``recording.samples``); these names are for files and people.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

_LINEAR = {
    "position_rad": "position_m",
    "position_command_rad": "position_command_m",
    "velocity_rad_s": "velocity_m_s",
    "torque_nm": "force_n",
    "torque_command_nm": "force_command_n",
    "torque_plus_minus_nm": "force_plus_minus_n",
    "torque_interval_nm": "force_interval_n",
    "external_torque_nm": "external_force_n",
    "rigid_body_torque_nm": "rigid_body_force_n",
    "torque_demand_nm": "force_demand_n",
    "rated_torque_nm": "rated_force_n",
    "coulomb_nm": "coulomb_n",
    "slopes_nm_s_per_rad": "slopes_n_s_per_m",
    "measured_range_rad_s": "measured_range_m_s",
    "presliding_stiffness_nm_per_rad": "presliding_stiffness_n_per_m",
    "presliding_level_nm": "presliding_level_n",
    "inertia_kg_m2": "mass_kg",
    "gravity_cos_nm": "gravity_cos_n",
    "gravity_sin_nm": "gravity_sin_n",
    "bias_nm": "bias_n",
    "distance_nm": "distance_n",
    "e_nm": "e_n",
    "e_measured_nm": "e_measured_n",
    "amplitude_rad": "amplitude_m",
    "period_rad": "period_m",
}
_ROTARY = {linear: rotary for rotary, linear in _LINEAR.items()}


def linear_name(name: str) -> str:
    """The name on a linear axis of what is called ``name`` on a rotary joint."""
    return _LINEAR.get(name, name)


def rotary_name(name: str) -> str:
    """The other way."""
    return _ROTARY.get(name, name)


def linear_names(values: Any) -> Any:
    """The same values with every key, at every depth, as on a linear axis."""
    return _renamed(values, linear_name)


def rotary_names(values: Any) -> Any:
    """The other way."""
    return _renamed(values, rotary_name)


def _renamed(values: Any, name: Callable[[str], str]) -> Any:
    if isinstance(values, dict):
        return type(values)((name(key), _renamed(value, name)) for key, value in values.items())
    if isinstance(values, list):
        return [_renamed(value, name) for value in values]
    return values
