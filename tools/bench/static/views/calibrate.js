// Wizards: poses by hand with a live arrow, warm-up, identification on the emulated lab; applied or discarded.
import { get, post } from "../api.js";
import { css, digits, duration, h } from "../dom.js";
import { holdSpans } from "../holds.js";
import { Strip } from "../plot.js";
import { poseWizard } from "./calibrate_poses.js";

export function mount(root, { link }) {
  const problem = h("span.bad", { role: "alert" });
  const fail = (error) => { problem.textContent = error.message; };
  const applied = h("span");
  const discard = h("button", { onclick: () => act(() => post("/api/calibrate/discard")) }, "Discard, back to the original");
  const act = async (work) => {
    problem.textContent = "";
    try { await work(); } catch (error) { fail(error); }
    poll();
  };
  const apply = (kind) => act(() => post("/api/calibrate/apply", { kind }));
  const wizard = poseWizard(link, apply, fail);

  const strip = new Strip([{ label: "temperature of the sensors", unit: "°C" }], { least: 0.5, xTitle: "time, s", yTitle: "°C" });
  const warmth = h("b");
  const labStatus = h("span.soft.num");
  const labResult = h("div");
  const labButtons = [["piezo", "Identify the stacks"], ["tumble", "Turn through 100 attitudes"]].map(([what, text]) => {
    const button = h("button", { onclick: () => act(() => post("/api/calibrate/lab", { what })) }, text);
    return button;
  });

  root.append(h("div.cols.calibrate", {},
    h("div.row.top", {}, applied, discard, problem),
    wizard.element,
    h("div.stack", {},
      h("section.panel.fig.warm", {}, h("h2", {}, "Warm-up ", warmth), strip.element),
      h("section.panel.lab", {}, h("h2", {}, "Stage and interferometer ", h("small", {}, "of the emulated lab")),
        h("div.row", {}, labButtons, labStatus), labResult,
        h("p.note", {}, "On a real bench use your own instruments and micron calibrate; the results can be applied in the bench file.")))));

  function showLab(job) {
    labStatus.textContent = job.state === "none" ? "" : `${job.state === "running" ? `step ${job.step + 1} of ${job.steps}` : job.state}, ${duration(job.seconds)}`;
    labButtons.forEach((b) => { b.disabled = job.state === "running" || !link.mayOrder || !link.state?.emulated; });
    if (job.state === "none") return;
    const kind = job.title.startsWith("piezo") ? "piezo" : "tumble";
    const table = h("pre.num.lines", { tabIndex: 0, role: "log", "aria-label": "What the identification says" }, job.lines.slice(-14).join("\n"));
    labResult.replaceChildren(table, job.state === "done" ? h("button.primary", { disabled: !link.mayOrder, onclick: () => apply(kind) }, "Apply to this bench") : "");
  }

  let timer = 0;
  async function poll() {
    clearTimeout(timer);
    try {
      const state = await get("/api/calibrate");
      showLab(state.job);
      applied.textContent = state.applied.length ? `Applied over the bench file: ${state.applied.join(", ")}; the firmware was started again with it.` : "The bench runs with the calibration of its file.";
      discard.hidden = !state.applied.length;
      const warm = await get("/api/calibrate/warmth");
      warmth.textContent = warm.text;
      warmth.style.color = warm.steady === undefined ? css("--soft") : css(warm.steady ? "--good" : "--warn");
      if (warm.t.length) strip.show(Float64Array.from(warm.t), [Float32Array.from(warm.temperature)], warm.t[0], warm.t[warm.t.length - 1], null, holdSpans(link.state?.holds, 0, warm.t[0], warm.t[warm.t.length - 1]));
    } catch (error) { fail(error); }
    timer = setTimeout(poll, 1000);
  }
  poll();
  const retheme = () => strip.build();
  window.addEventListener("themechange", retheme);
  return () => { clearTimeout(timer); wizard.destroy(); strip.destroy(); window.removeEventListener("themechange", retheme); };
}
