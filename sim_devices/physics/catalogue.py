"""Every effect of the vocabulary, by its contract name, in the contract's order."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

from hal import plugins
from sim_devices.physics.axes import CROSS_AXIS_NONLINEARITY, MISALIGNMENT, SCALE_FACTOR_VARIATION, SOFT_IRON
from sim_devices.physics.backlash import BACKLASH
from sim_devices.physics.clock_skew import CLOCK_SKEW
from sim_devices.physics.creep import CREEP
from sim_devices.physics.curve import STATIC_NONLINEARITY
from sim_devices.physics.damping import AMPLITUDE_DAMPING, QUADRATIC_DRAG
from sim_devices.physics.dead_zone import DEAD_ZONE
from sim_devices.physics.delay import CHANNEL_DELAY, DEAD_TIME
from sim_devices.physics.diode import ONE_SIDED_CONDUCTION
from sim_devices.physics.drift import RANDOM_WALK
from sim_devices.physics.dropped_samples import DROPPED_SAMPLES
from sim_devices.physics.effect import Effect
from sim_devices.physics.environment import CURRENT_COUPLING, SUPPLY_SENSITIVITY, TEMPERATURE_SENSITIVITY
from sim_devices.physics.flows import OVERFLOW, SQUARE_ROOT_OUTFLOW
from sim_devices.physics.friction import BOUC_WEN, COULOMB_FRICTION, SMOOTH_SPRING, STRIBECK_FRICTION
from sim_devices.physics.heat_loss import NONLINEAR_HEAT_LOSS
from sim_devices.physics.hysteresis import HYSTERESIS
from sim_devices.physics.lag import AC_COUPLING, FIRST_ORDER_LAG
from sim_devices.physics.lines import MAINS_INTERFERENCE, VIBRATION
from sim_devices.physics.load import CONSTANT_LOAD
from sim_devices.physics.parameter import DIRECTION_DEPENDENCE, PARAMETER_VARIATION
from sim_devices.physics.proportional import LINEAR_LOSS, LINEAR_STIFFNESS, VISCOUS_FRICTION
from sim_devices.physics.quantization import QUANTIZATION
from sim_devices.physics.rate_hysteresis import RATE_DEPENDENT_HYSTERESIS
from sim_devices.physics.resonance import RESONANCE
from sim_devices.physics.rigid import CENTRIPETAL_ACCELERATION, SENSOR_POSITION_ERROR
from sim_devices.physics.saturation import SATURATION
from sim_devices.physics.scale import SCALE_ERROR, ZERO_ERROR
from sim_devices.physics.slew import SLEW_LIMIT
from sim_devices.physics.spikes import SPIKES
from sim_devices.physics.spring import CLEARANCE, COGGING_FORCE, CUBIC_STIFFNESS, GRAVITY_LOAD
from sim_devices.physics.step_shift import STEP_SHIFT
from sim_devices.physics.warm_up import THERMAL_DRIFT

_ALL = (
    # its smooth springs are friction's bristles over a larger distance
    replace(HYSTERESIS, variants=(*HYSTERESIS.variants, SMOOTH_SPRING, BOUC_WEN)),
    RATE_DEPENDENT_HYSTERESIS,
    CREEP,
    BACKLASH,
    DEAD_ZONE,
    SATURATION,
    STATIC_NONLINEARITY,
    SLEW_LIMIT,
    FIRST_ORDER_LAG,
    AC_COUPLING,
    RESONANCE,
    DEAD_TIME,
    MISALIGNMENT,
    CROSS_AXIS_NONLINEARITY,
    SCALE_FACTOR_VARIATION,
    THERMAL_DRIFT,
    TEMPERATURE_SENSITIVITY,
    SUPPLY_SENSITIVITY,
    CURRENT_COUPLING,
    SOFT_IRON,
    MAINS_INTERFERENCE,
    VIBRATION,
    SPIKES,
    STEP_SHIFT,
    RANDOM_WALK,
    CLOCK_SKEW,
    DROPPED_SAMPLES,
    QUANTIZATION,
    COULOMB_FRICTION,
    STRIBECK_FRICTION,
    CUBIC_STIFFNESS,
    COGGING_FORCE,
    CENTRIPETAL_ACCELERATION,
    SENSOR_POSITION_ERROR,
    CHANNEL_DELAY,
    QUADRATIC_DRAG,
    AMPLITUDE_DAMPING,
    CLEARANCE,
    GRAVITY_LOAD,
    SQUARE_ROOT_OUTFLOW,
    OVERFLOW,
    NONLINEAR_HEAT_LOSS,
    PARAMETER_VARIATION,
    DIRECTION_DEPENDENCE,
    ONE_SIDED_CONDUCTION,
    CONSTANT_LOAD,
    SCALE_ERROR,
    ZERO_ERROR,
    VISCOUS_FRICTION,
    LINEAR_STIFFNESS,
    LINEAR_LOSS,
)


class _Vocabulary(Mapping[str, Effect]):
    """Maps names to effects: built-in ones, then those of installed packages (entry points of ``micron.effects``).

    Packages are looked up when they are asked for.
    """

    def __init__(self) -> None:
        self._ours = {e.name: e for e in _ALL}

    def _added(self) -> list[str]:
        return sorted(set(plugins.offered(plugins.EFFECTS)) - set(self._ours))

    def __getitem__(self, name: str) -> Effect:
        effect = self._ours.get(name) or plugins.load(plugins.EFFECTS, name, Effect)
        if effect is None:
            raise KeyError(name)
        return effect

    def __iter__(self) -> Iterator[str]:
        return iter((*self._ours, *self._added()))

    def __len__(self) -> int:
        return len(self._ours) + len(self._added())


EFFECTS: Mapping[str, Effect] = _Vocabulary()
