"""The targeting experiment: button, spike filter, matching, what is written down."""

from __future__ import annotations

import json
import math

import pytest
from pydantic import ValidationError

from firmware_py.endoscope.control import INACTIVE, MOVE, ZOOM, ControlConfig
from firmware_py.endoscope.targets import GameConfig, GameState, TargetGame

DT_S = 0.01


class Player:
    """Presses and points without a mistake; time goes on by 10 ms a step."""

    def __init__(self, game: TargetGame) -> None:
        self.game = game
        self.t = 0.0
        self.pointer = (0.0, 0.0)

    def hold(self, seconds: float, *, button: bool = False) -> GameState:
        state = self.game.state()
        for _ in range(round(seconds / DT_S)):
            state = self.game.step(self.pointer, button, self.t)
            self.t += DT_S
        return state

    def press(self, seconds: float) -> GameState:
        self.hold(seconds, button=True)
        return self.hold(0.05)

    def point(self, psi: float, theta: float) -> GameState:
        self.pointer = (self.pointer[0] + psi, self.pointer[1] + theta)
        return self.hold(0.05)

    def reach(self) -> GameState:
        """Move, leave, zoom, leave: two presses for each, as section 6.2 has it."""
        gain = self.game.config.control.gain
        off, reached = self.game.state().off_px, self.game.state().reached
        self.press(0.1)
        self.point(-off[0] / gain, -off[1] / gain)
        if self.game.state().reached > reached:
            return self.press(0.1)
        self.press(0.1)
        off = self.game.state().off_px
        self.press(0.6)
        self.point(-off[2] / gain, 0.0)
        return self.press(0.1)

    def play(self) -> GameState:
        state = self.game.state()
        for _ in range(self.game.config.targets):
            state = self.reach()
        return state


def prompt(**more: object) -> GameConfig:
    return GameConfig(control=ControlConfig(response_s=0.0), **more)  # type: ignore[arg-type]


def test_a_perfect_player_reaches_all_targets() -> None:
    game = TargetGame(prompt(seed=3))
    state = Player(game).play()
    assert state.done
    assert game.done
    assert state.reached == state.of == len(game.results) == 5
    assert state.target is None
    assert state.off_px == (0.0, 0.0, 0.0)
    assert sum(r.elapsed_s for r in game.results) == pytest.approx(state.elapsed_s)
    # the last press of all comes after the last match
    assert 10 <= sum(r.clicks for r in game.results) <= 20
    assert all(r.elapsed_s > 0.0 and r.rotations_deg for r in game.results)


def test_rotations_are_those_since_the_activation() -> None:
    game = TargetGame(prompt(seed=3))
    player = Player(game)
    player.pointer = (20.0, -30.0)
    off = game.state().off_px
    player.press(0.1)
    player.point(-off[0] / 8.0, -off[1] / 8.0)
    assert game.state().turn_deg == pytest.approx((-off[0] / 8.0, -off[1] / 8.0))
    assert max(abs(v) for v in game.state().off_px[:2]) < 1e-9


def test_short_and_long_press_give_status_1_and_2() -> None:
    game = TargetGame(prompt())
    player = Player(game)
    assert player.press(0.3).status == MOVE
    assert player.press(0.3).status == INACTIVE
    assert player.press(0.5 + DT_S).status == ZOOM
    assert player.press(0.1).status == INACTIVE
    assert game.clicks == 4


def test_the_spike_of_the_button_is_kept_out() -> None:
    game = TargetGame(prompt())
    player = Player(game)
    player.press(0.1)
    before = game.state().view
    # while the button is down and 20 ms after it, wild angles do nothing; the release ends the activation
    player.pointer = (40.0, 40.0)
    player.hold(0.1, button=True)
    player.hold(0.02)
    assert game.state().view == before
    player.press(0.1)
    assert game.state().view == before


def test_tolerance_is_per_coordinate() -> None:
    def nearest(offset_px: float) -> int:
        game = TargetGame(prompt(seed=5))
        player = Player(game)
        off = game.state().off_px
        player.press(0.6)
        player.point(-off[2] / 8.0, 0.0)
        player.press(0.1)
        player.press(0.1)
        off = game.state().off_px
        return player.point(-(off[0] + offset_px) / 8.0, -(off[1] + offset_px) / 8.0).reached

    assert nearest(8.99) == 1
    assert nearest(9.01) == 0


def test_same_seed_same_targets_and_targets_are_on_the_screen() -> None:
    def targets(seed: int) -> list[object]:
        game = TargetGame(prompt(seed=seed))
        player = Player(game)
        found: list[object] = [game.target]
        for _ in range(5):
            player.reach()
            found.append(game.target)
        return found[:5]

    assert targets(1) == targets(1) != targets(2)
    for target in targets(7):
        assert target is not None
        half = target.size / 2  # type: ignore[attr-defined]
        assert half <= target.x <= 640 - half  # type: ignore[attr-defined]
        assert half <= target.y <= 480 - half  # type: ignore[attr-defined]


def test_a_card_drives_it_too() -> None:
    game = TargetGame(prompt())
    game.step_card((0.0, 0.0), INACTIVE, 0.0)
    game.step_card((0.0, 0.0), MOVE, 0.01, use=False)
    game.step_card((9.0, 9.0), MOVE, 0.02, use=False)  # masked: the click's spike
    start = game.step_card((1.0, 1.0), MOVE, 0.03).view
    moved = game.step_card((2.0, 1.0), MOVE, 0.04).view
    assert moved.x - start.x == pytest.approx(8.0)
    assert game.clicks == 1


def test_the_state_is_json_and_a_hidden_page_does_not_jump() -> None:
    game = TargetGame(GameConfig(control=ControlConfig(mapping="speed", response_s=0.0)))
    player = Player(game)
    player.press(0.1)
    start = player.point(1.0, 0.0).view.x
    state = game.step(player.pointer, False, player.t + 60.0)
    assert state.view.x - start == pytest.approx(8.0 * 0.1)
    assert json.loads(json.dumps(state.as_dict()))["status"] == MOVE


def test_bad_input_is_refused() -> None:
    game = TargetGame()
    game.step((0.0, 0.0), False, 1.0)
    with pytest.raises(ValueError, match="backwards"):
        game.step((0.0, 0.0), False, 0.9)
    with pytest.raises(ValueError, match="finite"):
        game.step((math.nan, 0.0), False, 2.0)
    with pytest.raises(ValidationError, match="too small"):
        GameConfig(control=ControlConfig(width_px=150, height_px=150))
    with pytest.raises(ValidationError, match="target_sizes_px"):
        GameConfig(target_sizes_px=(10.0, 20.0))
