"""The hand that holds the instrument: what it means to do and what it cannot help doing.

What is known, and what was chosen:

- Physiological tremor of the hand is a linear stochastic process, driven by noise, not an oscillator (Gantert 1991
  in Ang 2004 ch. 1; Timmer, Lauk, Pfleger, Deuschl 1998, chao-dyn/9805011): a Gaussian narrow-band signal whose
  amplitude is Rayleigh distributed, fades and slips in phase. Its amplitude changes fast, its frequency slower (Ang
  2004 ch. 1), and both widen the line (Gresty and Buckwell 1990). Here: a complex Gaussian envelope of 0.6 s
  correlation time on a carrier near 9.6 Hz (0.78 Hz between half-power points), a frequency wander of 0.4 Hz rms over 2
  s and a common gain of +-30 % over 4 s. Together 0.9 to 1.5 Hz between half-power points, 0.6 Hz standard deviation of
  the spectrum. No width is published in Ang 2004; the recordings at hand (shared/data: arm extended 0.75 Hz, mouse hand
  1.0 Hz where the peak stands out) are as wide. A sharper line would be easier to predict than a hand.
- Size: 50 um peak to peak per axis at the tip (Hunter 1993 in Ang 2004), so 17.7 um rms per body axis and 30.7 um rms
  as a vector (38 um: Singh 2002 in Ang 2004). The three axes share carrier and gain, their envelopes are correlated by
  0.4. 60 % of the lateral motion is a turn about the grip, 90 mm behind the tip.
- Jerk (normal myoclonus) and drift are often larger than tremor (Riviere, Rader, Khosla 1997, in Ang 2004 ch. 1);
  between drift and tremor there is broadband unsteadiness of some micrometres.
- Voluntary motion: minimum-jerk reaches (Flash and Hogan 1985) of 1.2 to 3 s with rests between them; no content
  above 1 Hz to speak of.

All parts have exact first and second derivatives, so an accelerometer on the hand reads the acceleration of the very
motion that the tip makes.
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from hal.arrays import Array
from sim_devices.config import HandConfig
from sim_devices.plant.hand_kernel import (
    DRIFT,
    FREQUENCY,
    GAIN,
    HAND,
    HAND_STATE,
    PROCESSES,
    SOURCES,
    UNSTEADY,
    hand_nodes,
    hand_pose,
)
from sim_devices.plant.smooth_noise import smooth_noise
from sim_devices.plant.streams import stream

NODE_S = 1e-3
"""A hand is given by nodes this far apart."""
_JERK_PAUSE_S = 1.0
PLANNED = 64
"""Number of reaches, and of jerks, that are planned at a time."""
POSE_HOLD_S = 1.5
"""Rest in each calibration pose, beside ``hold_s``: a second of it is taken."""


class Hand(Protocol):
    """A handle motion in nodes one millisecond apart, to be used once, from t = 0 on.

    Six coordinates: the point where the tip would be with the manipulator at neutral (world, m) and three small
    angles (rad) with C_WB = frame Rz(c5) Ry(c4) Rx(c3); then their first and second derivatives.
    """

    @property
    def frame(self) -> Array:
        """(3, 3) attitude that the angles are counted from."""
        ...

    def start(self, pose: Array, parts: Array) -> None:
        """Fill ``pose`` (18,) and ``parts`` (6,), the intended and tremor part of the tip path, at t = 0."""
        ...

    def fill(self, pose: Array, parts: Array) -> None:
        """Fill the next n nodes: ``pose`` (n, 18), ``parts`` (n, 6)."""
        ...


def holding_frame(config: HandConfig) -> Array:
    """Return the attitude (3, 3) of an instrument held like a pen: its axis points down, tilted and turned as
    configured."""
    azimuth, pitch, roll = (math.radians(v) for v in (config.azimuth_deg, 180.0 - config.tilt_deg, config.roll_deg))
    return _rz(azimuth) @ _ry(pitch) @ _rz(roll)


def pose_angles() -> Array:
    """(14, 3) angles, close to each other in the list: up is each half axis and each octant of the body once.

    With the identity as frame, up in body axes is (-sin a1, cos a1 sin a0, cos a1 cos a0): it stays on a cone about
    the body's x axis while the instrument rolls.
    """
    corner = math.asin(1.0 / math.sqrt(3.0))
    square, diagonal = np.radians([0.0, 90.0, 180.0, 270.0]), np.radians([45.0, 135.0, 225.0, 315.0])
    rings = [(-math.pi / 2, diagonal[:1]), (-corner, diagonal), (0.0, square[::-1]), (corner, diagonal)]
    rings.append((math.pi / 2, diagonal[-1:]))
    return np.array([[roll, pitch, 0.0] for pitch, rolls in rings for roll in rolls])


def tremor_matrix(config: HandConfig, frame: Array) -> Array:
    """Return the matrix (6, 6) from unit sources to tip displacement (world, m) and body angles (rad).

    Turning by (ax, ay) about a grip that lies L behind the tip moves the tip by (ay L, -ax L); the angles are the
    share of the lateral motion that is made this way, plus the independent roll and a tenth of wobble.
    """
    rms_m = config.tremor_pp_um * 1e-6 / (2.0 * math.sqrt(2.0))
    correlation = np.full((3, 3), config.axis_correlation) + (1.0 - config.axis_correlation) * np.eye(3)
    body = rms_m * np.linalg.cholesky(correlation)
    angle = config.rotation_share / (config.grip_to_tip_mm * 1e-3)
    matrix = np.zeros((SOURCES, SOURCES))
    matrix[:3, :3] = frame @ body
    matrix[3, :3] = -angle * body[1]
    matrix[4, :3] = angle * body[0]
    if rms_m > 0.0:
        matrix[3, 3] = matrix[4, 4] = 0.1 * angle * rms_m
        matrix[5, 5] = config.roll_tremor_mrad * 1e-3
    return matrix


class SyntheticHand:
    """The stochastic hand of the module's docstring; one seed is one person and one performance."""

    def __init__(self, config: HandConfig, seed: int) -> None:
        self._config, self._seed = config, seed
        self.frame = np.eye(3) if config.performs == "poses" else holding_frame(config)
        person = stream(seed, "hand.person").standard_normal()
        low, high = min(8.5, config.tremor_frequency_hz), max(11.5, config.tremor_frequency_hz)
        frequency_hz = config.tremor_frequency_hz + person * config.tremor_frequency_spread_hz
        self._p = np.zeros(1, HAND)
        p = self._p[0]
        p["step_s"] = NODE_S
        p["frequency_hz"] = min(max(frequency_hz, low), high)
        p["wander_hz"], p["depth"] = config.frequency_wander_hz, config.amplitude_depth
        p["tremor"] = tremor_matrix(config, self.frame)
        p["drift_m"], p["unsteadiness_m"] = config.drift_rms_um * 1e-6, config.unsteadiness_rms_um * 1e-6
        times = np.full(PROCESSES, config.envelope_s)
        times[GAIN], times[FREQUENCY] = config.amplitude_s, config.frequency_wander_s
        times[DRIFT : DRIFT + 3], times[UNSTEADY : UNSTEADY + 3] = config.drift_s, config.unsteadiness_s
        self._s = np.zeros(1, HAND_STATE)
        start = stream(seed, "hand.start")
        designs = {t: smooth_noise(float(t), NODE_S) for t in np.unique(times)}
        for n, t in enumerate(times):
            p["transition"][n], p["drive"][n] = designs[t].transition, designs[t].drive
            self._s[0]["x"][n] = designs[t].stationary @ start.standard_normal(3)
        p["integral"] = designs[times[FREQUENCY]].integral
        p["integral_drive"] = designs[times[FREQUENCY]].integral_drive
        self._s[0]["phase"] = start.uniform(0.0, 2.0 * math.pi)
        self._noise = stream(seed, "hand.noise")
        self._reaching = stream(seed, "hand.reaches")
        self._jerking = stream(seed, "hand.jerk.times"), stream(seed, "hand.jerk.sizes")
        self._reaches, self._jerks = np.zeros((0, 14)), np.zeros((0, 5))
        self._reached, self._reached_s, self._jerked_s = 0, 0.0, 0.0
        self._plan_reaches()
        self._plan_jerks()

    @property
    def tremor_frequency_hz(self) -> float:
        """This person's mean tremor frequency."""
        return float(self._p[0]["frequency_hz"])

    def start(self, pose: Array, parts: Array) -> None:
        hand_pose(self._p[0], self._s[0], self._reaches, self._jerks, pose, parts)

    def fill(self, pose: Array, parts: Array) -> None:
        end_s = (int(self._s[0]["step"]) + pose.shape[0]) * NODE_S
        while end_s > self._reaches[-1, 0]:
            self._plan_reaches()
        while end_s > self._jerks[-1, 0]:
            self._plan_jerks()
        noise = self._noise.standard_normal((pose.shape[0], PROCESSES))
        hand_nodes(self._p, self._s, noise, (self._reaches, self._jerks), pose, parts)

    def _plan_reaches(self) -> None:
        """Plan the next reaches and drop those that are over."""
        config, past = self._config, int(self._s[0]["reach"])
        draw = self._reaching.random((PLANNED, 8))
        duration = config.reach_s[0] + (config.reach_s[1] - config.reach_s[0]) * draw[:, 0]
        hold = config.hold_s[0] + (config.hold_s[1] - config.hold_s[0]) * draw[:, 1]
        size = np.repeat([config.voluntary_range_um * 1e-6, math.radians(config.voluntary_angle_deg)], 3)
        target = (2.0 * draw[:, 2:] - 1.0) * size
        if config.performs == "poses":
            hold += POSE_HOLD_S
            target[:, 3:] += pose_angles()[(self._reached + np.arange(PLANNED)) % len(pose_angles())]
        ends_s = np.cumsum(np.concatenate([[self._reached_s], hold + duration]))[1:]
        more = np.zeros((PLANNED, 14))
        more[:, 0] = ends_s - duration
        more[:, 1] = duration
        more[0, 2:8] = self._reaches[-1, 8:] if len(self._reaches) else 0.0
        more[1:, 2:8] = target[:-1]
        more[:, 8:] = target
        self._reaches = np.concatenate([self._reaches[past:], more])
        self._s[0]["reach"] = 0
        self._reached, self._reached_s = self._reached + PLANNED, float(ends_s[-1])

    def _plan_jerks(self) -> None:
        """Plan the next jerks and drop those that are over."""
        config, past = self._config, int(self._s[0]["jerk"])
        times, sizes = self._jerking
        wait_s = times.exponential(config.jerk_interval_s, PLANNED)
        shape = sizes.standard_normal((PLANNED, 4))
        more = np.zeros((PLANNED, 5))
        more[:, 0] = np.cumsum(np.concatenate([[self._jerked_s], wait_s + _JERK_PAUSE_S]))[1:]
        more[:, 1] = 0.035 * np.exp(0.2 * shape[:, 0])
        more[:, 2:] = config.jerk_um * 1e-6 / math.sqrt(3.0) * shape[:, 1:]
        self._jerks = np.concatenate([self._jerks[past:], more])
        self._s[0]["jerk"] = 0
        self._jerked_s = float(more[-1, 0])


def _ry(a: float) -> Array:
    c, s = math.cos(a), math.sin(a)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def _rz(a: float) -> Array:
    c, s = math.cos(a), math.sin(a)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
