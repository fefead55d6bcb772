// Which channels the scope shows: by group, with presets.
import { h, unitText } from "../dom.js";

const PRESETS = [
  ["Sensors, volts", ["volts", "supply", "magnetometer_raw"]],
  ["Sensors, raw counts", ["counts"]],
  ["Sensors, calibrated", ["accelerometer", "magnetometer", "temperature"]],
  ["Sensor", ["accel", "gyro", "temperature"]],
  ["View", ["psi", "theta", "view_x", "view_y", "view_size", "status"]],
  ["Motion of the body", ["specific_force", "rate", "angular_acceleration", "quaternion"]],
  ["Tip and tremor", ["tip_displacement", "tremor", "tremor_ahead", "confidence"]],
  ["Actuators", ["desired_tip", "stroke", "command", "clip"]],
  ["20 channels", ["volts", "accelerometer", "magnetometer", "command"]],
];
export const MAX_CHANNELS = 32;

export function channelPicker(catalogue, settings, changed) {
  const boxes = new Map();
  const groups = [...new Set(catalogue.map((c) => c.group))];
  const presets = PRESETS.filter(([, names]) => names.every((name) => groups.includes(name)));
  const details = groups.map((group) => {
    const members = catalogue.filter((c) => c.group === group);
    const all = h("input", { type: "checkbox", "aria-label": `All of ${group.replaceAll("_", " ")}`, onchange: () => choose(members.map((m) => m.name), all.checked) });
    const list = members.map((c) => {
      const box = h("input", { type: "checkbox", onchange: () => choose([c.name], box.checked) });
      boxes.set(c.name, box);
      return h("label", {}, box, h("span.num", { style: "font-size:12px" }, c.name));
    });
    const element = h("div.group", { title: members[0].what }, all,
      h("details", {}, h("summary", {}, `${group.replaceAll("_", " ")} `, h("span.faint", {}, unitText(members[0].unit))), list));
    element.check = () => {
      const on = members.filter((m) => settings.channels.includes(m.name)).length;
      all.checked = on === members.length;
      all.indeterminate = on > 0 && on < members.length;
    };
    return element;
  });

  function show() {
    for (const [name, box] of boxes) box.checked = settings.channels.includes(name);
    details.forEach((d) => d.check());
  }

  function choose(names, on) {
    const left = settings.channels.filter((name) => !names.includes(name));
    settings.channels = (on ? [...left, ...names] : left).slice(0, MAX_CHANNELS);
    settings.channels.sort((a, b) => catalogue.findIndex((c) => c.name === a) - catalogue.findIndex((c) => c.name === b));
    show();
    changed();
  }

  const preset = h("select", { "aria-label": "Preset", style: "width:100%", onchange: () => {
    const wanted = presets[Number(preset.value)]?.[1];
    if (wanted) {
      settings.channels = [];
      choose(catalogue.filter((c) => wanted.includes(c.group)).map((c) => c.name), true);
    }
    preset.value = "";
  } }, h("option", { value: "" }, "Preset …"), presets.map(([title], i) => h("option", { value: i }, title)));
  show();
  return h("div.panel.picker", {}, h("h2", {}, "Channels"), preset, h("div", { style: "margin-top:6px" }, details));
}
