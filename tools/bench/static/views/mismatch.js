// Where twin and recording differ: pick, run, watch, read, take the corrected twin away.
import { blobUrl, download, get, post } from "../api.js";
import { duration, h } from "../dom.js";
import { newRecording } from "./mismatch_new.js";
import { watchPanel } from "./mismatch_watch.js";

const STEPS = { 2: ["locate and fit", "corrected twin"], 3: ["prepare", "locate and fit", "corrected twin"] };

export function mount(root, { link }) {
  let shown = "";
  let timer = 0;
  let compareTimer = 0;
  let inUse = false;
  const select = h("select", { "aria-label": "Recording" });
  const run = h("button.primary", { onclick: start }, "Diagnose");
  const cancel = h("button", { onclick: () => post("/api/jobs/mismatch/cancel").then(poll).catch(fail) }, "Cancel");
  const problem = h("span.bad", { role: "alert" });
  const files = h("span.row");
  const apply = h("button", { hidden: true, title: "Start the emulated bench again with the corrected twin in its stacks' place", onclick: applyTwin }, "Apply to the emulated bench");
  const back = h("button", { hidden: true, onclick: goBack }, "Back to the original bench");
  const applied = h("div.row", { hidden: true, style: "margin-top:8px" });
  const status = h("span.soft.num");
  const lines = h("pre.num.lines", { tabIndex: 0, role: "log", "aria-label": "What the engine says" });
  const report = h("div.report", {}, h("div.empty", {},
    h("p", {}, "Pick a recording. The engine compares it with its twin, names the physics that is missing and fits it on data that it then checks on the part it has not seen."),
    h("p", {}, "A run takes from half a minute to several, in a process of its own; the firmware does not notice.")));
  const own = newRecording(link, async (recording) => {
    problem.textContent = "";
    try {
      await refresh();
      select.value = recording;
      await start();
    } catch (error) { fail(error); }
  });
  const watch = watchPanel(link, lastMinute);
  const view = h("div.cols.mismatch", {},
    h("div.stack", {}, watch.element,
      h("section.panel", {}, h("div.row", {}, select, run, cancel, own.open, own.pick, h("span.faint", {}, "or drop a csv, npz or mcap here"), status, h("span.grow"), files, apply, back), problem, own.problem, applied, lines)),
    h("div.stack", {}, own.form, report));
  own.dropOn(view);
  root.append(view);

  const fail = (error) => { problem.textContent = error.message; };

  async function refresh() {
    const state = await get("/api/mismatch");
    select.replaceChildren(...state.recordings.map((name) => h("option", { value: name }, name)));
    const wanted = JSON.parse(localStorage.getItem("micron.mismatch") || "null")?.recording; // sent here from a replay
    localStorage.removeItem("micron.mismatch");
    if (state.recordings.includes(wanted)) select.value = wanted;
    if (!state.recordings.length) select.replaceChildren(h("option", { value: "" }, `no recording in ${state.folder}`));
    showApplied(state.applied);
    show(state.job);
    if (state.difference.state !== "none") compare();
  }

  function showApplied(what) {
    inUse = what.includes("corrected twin");
    back.hidden = !inUse;
    if (!inUse) applied.hidden = true;
  }

  async function applyTwin() {
    problem.textContent = "";
    try { await post("/api/mismatch/apply"); await refresh(); } catch (error) { fail(error); }
  }

  async function goBack() {
    problem.textContent = "";
    try { await post("/api/calibrate/discard"); await refresh(); } catch (error) { fail(error); }
  }

  /** The same hand on both benches, on the emulated truth: what the twin changes at the tip. */
  async function compare() {
    clearTimeout(compareTimer);
    let found;
    try { found = await get("/api/mismatch/difference"); } catch (error) { fail(error); return; }
    const { job, before, after } = found;
    if (!inUse) return;
    applied.hidden = false;
    const said = (v, n, unit) => (v === null || v === undefined ? "–" : `${v.toFixed(n)} ${unit}`); // a run that was cut short has none
    const um = (v) => said(v, 2, "µm");
    const titles = ["tremor 8–12 Hz", "left of it", "less", "error, all bands"];
    const row = (name, r) => h("tr", {}, h("td.whole", {}, name), ...(r ? [um(r.band[0]), um(r.band[1]), said(r.band[2], 1, "%"), um(r.all[1])] : ["…", "…", "…", "…"]).map((v, i) => h("td.num", { "data-label": titles[i] }, v)));
    const waiting = job.state === "running" ? `step ${job.step + 1} of ${job.steps}, ${duration(job.seconds)}` : job.state === "done" ? "" : `${job.state}: ${job.lines.at(-1) || ""}`;
    applied.replaceChildren(h("table.cards", { id: "difference" }, h("thead", {},
      h("tr", {}, h("th", {}, "same hand, 10 s of virtual time, truth at the tip"), titles.map((t) => h("th.num", {}, t)))),
      row("bench as it was", before), row("with the corrected twin", after)),
    h("span.soft", {}, waiting || "The page runs the bench with the corrected twin now."));
    if (job.state === "running") compareTimer = setTimeout(compare, 700);
  }

  async function start() {
    problem.textContent = "";
    shown = "";
    report.replaceChildren();
    try { show(await post("/api/mismatch/start", { recording: select.value })); } catch (error) { fail(error); }
  }

  async function lastMinute() {
    problem.textContent = "";
    shown = "";
    report.replaceChildren();
    try { show(await post("/api/mismatch/last-minute")); } catch (error) { fail(error); }
  }

  async function poll() {
    try { show(await get("/api/jobs/mismatch")); } catch (error) { fail(error); }
  }

  async function show(job) {
    clearTimeout(timer);
    const running = job.state === "running";
    run.disabled = running || !link.mayOrder || !select.value;
    cancel.disabled = !running || !link.mayOrder;
    if (job.state === "none") return;
    const step = STEPS[job.steps]?.[job.step] || "";
    status.textContent = `${job.title}: ${running ? step : job.state}, ${duration(job.seconds)}`;
    lines.textContent = running || job.state === "failed" ? job.lines.slice(-8).join("\n") : "";
    if (job.files.includes("report.html") && shown !== job.title) {
      shown = job.title;
      const url = await blobUrl("/api/jobs/mismatch/files/report.html");
      report.replaceChildren(h("iframe.report", { src: url, title: "Mismatch report", sandbox: "allow-scripts" }));
    }
    files.replaceChildren(...["report.html", "report.json", "twin.toml"].filter((f) => job.files.includes(f))
      .map((f) => h("button", { onclick: () => download(`/api/jobs/mismatch/files/${f}`, f) }, f === "twin.toml" ? "Corrected twin" : f)));
    apply.hidden = !job.files.includes("twin.toml") || running || inUse || !link.state?.emulated;
    apply.disabled = !link.mayOrder;
    if (running) timer = setTimeout(poll, 700);
  }

  refresh().catch(fail);
  const offServer = link.on("server", () => refresh().catch(fail));
  return () => { offServer(); watch.stop(); clearTimeout(timer); clearTimeout(compareTimer); };
}
