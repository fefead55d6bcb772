// What every figure of the page means and what is normal, shown where it is pointed at, tapped or focused.
import { h } from "./dom.js";

export const FIGURES = {
  "run time": "Time since the firmware's first scan.",
  "sample to command p50": "Time from the instant at which a sample was taken to the acknowledged command, median since the start. Normal: below 2 ms, the delay over which the tremor is predicted.",
  "arrival to view p50": "Time from a sample's arrival to the view that follows from it, median since the start.",
  "lost scans": "Scans of the converter that never reached the firmware. Normal: 0.",
  "outputs held": "Share of ticks in which the outputs kept their last value because a new command would have come too late. Normal: 0 %; short holds do no harm.",
  tremor: "Amplitude of the estimated tremor at the tip, all three axes together.",
  task: "One step of a tick, or a task of its own rate.",
  rate: "How often the task is due.",
  p50: "Median since the start of the run, µs.",
  p99: "99 of 100 runs took no longer, µs. Normal: below the budget.",
  "p99.9": "999 of 1000 runs took no longer, µs.",
  worst: "The longest run since the start, µs.",
  budget: "What the task may take, from the task table, µs.",
  "of budget": "p99 as a share of the budget. The line is 100 %. Normal: left of the line.",
  over: "Runs that took longer than the budget. Normal: 0, or a few on a machine without real-time scheduling.",
  late: "Runs that ended after their deadline. Normal: 0.",
  held: "Runs that were left out because they would have come too late; the outputs are held meanwhile. Normal: 0.",
  "at tick": "Number of the tick with the longest run.",
  "held ticks": "Ticks that were left out altogether because the one before had not ended. Normal: 0.",
  reduction: "1 less the ratio of rms after to rms before, last 4 s. By the firmware's own estimate.",
  bands: "Motion of the tip as the sensors see it (tip_displacement, which leaves slow motion out), without compensation and less what was commanded one loop delay before. Normal: less in 8 to 12 Hz, little more elsewhere.",
  band: "Band of frequencies, Hz; rms within it.",
  without: "Motion of the tip without compensation, µm rms.",
  with: "The same less what was commanded one loop delay before, µm rms.",
  change: "With over without, less 1. Normal: far below 0 in 8 to 12 Hz.",
  rms: "Root of the mean square of the last 4 s.",
  before: "The estimated tremor, as it would be without compensation.",
  after: "The tremor less what was commanded one loop delay before.",
  gain: "Factor on the compensation. Normal: 1.",
  roll: "Turn about the instrument's x axis, the last of the order z, y, x.",
  pitch: "Turn about the y axis, the second of the order z, y, x. Near ±90° roll and yaw cannot be told apart.",
  yaw: "Turn about the vertical z axis, the first of the order z, y, x. Without a magnetometer it drifts.",
  quaternion: "Unit quaternion that turns vectors of the instrument into those of the world: w, x, y, z, with w at least 0.",
  "turned since zero": "Angle of the single rotation from the attitude at the last zero to the one now.",
  apart: "Angle of the single rotation between the attitudes of the two filters.",
  command: "Voltage that the firmware last commanded of this stack.",
  stroke: "Length of the stack beyond neutral by the hysteresis model, µm; the default amplifier does not measure it.",
  workspace: "The wanted displacement was out of reach: the nearest reachable one is commanded. Normal: ok.",
  voltage: "The command was limited to the range of the amplifier. Normal: ok.",
  slew: "The command moved as far as the amplifier can in one tick. Normal: ok.",
  lost: "Ticks that were dropped before they were written. Normal: 0.",
  targets: "Targets covered so far.",
  time: "Seconds since the first activation.",
  clicks: "Presses of the button, short and long.",
  "off by": "View less target: x, y and size. The target counts when all three are within the tolerance.",
  turns: "Activations that this target took.",
  bias: "Output at zero acceleration, at the nominal supply.",
  scale: "Change of the output per g, at the nominal supply.",
  "left over": "Residual of the size of the acceleration against gravity over all poses, for each set of three axes.",
  limited: "Commands that ran into the workspace, the amplifier's range or its slew limit. Normal: few, in large movements.",
};

/** Attributes that explain a figure: for a pointer, a finger and a screen reader. */
export const explained = (name) => (FIGURES[name] ? { title: FIGURES[name], "data-hint": name } : {});

/** The name of a figure, with its explanation. */
export const figure = (name, text = name) => h("span.what", { tabIndex: 0, ...explained(name) }, text);

/** Fingers have no pointer that rests: a tap on a figure, or Enter, says its explanation at the foot of the page. */
export function showHints(box) {
  const say = (event) => {
    const name = event.target.closest?.("[data-hint]")?.dataset.hint;
    box.hidden = !name;
    if (name) box.replaceChildren(h("b", {}, name), ` ${FIGURES[name]}`);
  };
  document.addEventListener("click", say);
  document.addEventListener("keydown", (event) => { if (event.key === "Enter" && event.target.matches?.("[data-hint]")) say(event); });
}
