"""Every effect of the vocabulary, by its contract name."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from sim_devices.physics.effect import Effect
from sim_devices.physics.hysteresis import HYSTERESIS
from sim_devices.physics.lag import FIRST_ORDER_LAG
from sim_devices.physics.lines import MAINS_INTERFERENCE
from sim_devices.physics.saturation import SATURATION

_ALL = (HYSTERESIS, SATURATION, FIRST_ORDER_LAG, MAINS_INTERFERENCE)
EFFECTS: Mapping[str, Effect] = MappingProxyType({e.name: e for e in _ALL})
