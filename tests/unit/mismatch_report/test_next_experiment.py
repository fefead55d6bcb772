"""What to record next answers what the report left open."""

from dataclasses import replace

from tests.unit.mismatch_report.canned import agrees, missing_physics, unexplained
from tools.mismatch.engine.report import DependsOn, ParameterValue
from tools.mismatch.report.next_experiment import next_experiments


def said(report) -> list[str]:
    return [f"{e.what}: {e.why}" for e in next_experiments(report)]


def test_twins_of_an_effect_come_first():
    assert said(missing_physics())[0] == "two steps of opposite sign: tells apart creep, ac coupling"


def test_a_vague_parameter_asks_for_the_excitation_that_shows_it():
    r = missing_physics()
    vague = {"total_fraction": ParameterValue(0.1, "1", (-0.1, 0.3))}
    r = replace(r, equivalent=(), physics=(replace(r.physics[0], parameters=vague),))
    assert "steps or changes of the mean" in said(r)[0]
    assert "not even in sign" in said(r)[0]


def test_an_estimated_noise_floor_asks_for_a_rest_record():
    assert any("at rest" in s for s in said(missing_physics()))
    assert not any("at rest" in s for s in said(agrees()))


def test_unexplained_asks_for_the_signal_that_it_follows():
    assert said(unexplained())[0].startswith("the same path of command at three speeds")
    by_time = replace(unexplained().location, depends_on=(DependsOn("time", "time itself", 0.5),))
    assert "after an hour of running" in said(replace(unexplained(), location=by_time))[0]
    nothing = replace(unexplained().location, depends_on=())
    assert "follows no recorded signal" in said(replace(unexplained(), location=nothing))[0]


def test_an_output_that_it_follows_is_reached_by_way_of_the_inputs():
    r = unexplained()
    (output,) = r.fit.unit
    by_output = replace(r.location, depends_on=(DependsOn(output, "recent history", 0.5),))
    assert said(replace(r, location=by_output))[0].startswith(f"by way of the inputs, a step of {output}")


def test_a_slow_recording_is_not_asked_for_seconds_at_rest():
    assert any(s.startswith("a thousand samples with the input at rest") for s in said(missing_physics()))


def test_agrees_names_what_it_could_not_have_seen():
    want = "amplitudes that reach the limits, and smaller ones for comparison: shows saturation, which this"
    assert [s.startswith(want) for s in said(agrees())] == [True]
    nothing = {"spikes": "none; the longer the record, the more events"}
    assert said(replace(agrees(), cannot_show=nothing))[0].startswith("another waveform")
