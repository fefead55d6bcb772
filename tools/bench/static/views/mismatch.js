// Where twin and recording differ: pick, run, watch, read, take the corrected twin away.
import { blobUrl, download, get, post } from "../api.js";
import { duration, h } from "../dom.js";

const STEPS = { 2: ["locate and fit", "corrected twin"], 3: ["prepare", "locate and fit", "corrected twin"] };

export function mount(root, { link }) {
  let shown = "";
  let timer = 0;
  const select = h("select", { "aria-label": "Recording", style: "min-width:320px" });
  const run = h("button.primary", { onclick: start }, "Diagnose");
  const cancel = h("button", { onclick: () => post("/api/jobs/mismatch/cancel").then(poll).catch(fail) }, "Cancel");
  const problem = h("span.bad", { role: "alert" });
  const files = h("span.row");
  const status = h("span.soft.num");
  const lines = h("pre.num", { style: "margin:8px 0 0;font-size:11.5px;line-height:1.5;max-height:130px;overflow:auto;white-space:pre-wrap" });
  const report = h("div", { style: "min-height:0;height:100%" }, h("div.empty", {},
    h("p", {}, "Pick a recording. The engine compares it with its twin, names the physics that is missing and fits it on data that it then checks on the part it has not seen."),
    h("p", {}, "A run takes from half a minute to several, in a process of its own; the firmware does not notice.")));
  root.append(h("div.cols", { style: "grid-template-rows:auto minmax(0,1fr)" },
    h("section.panel", {}, h("div.row", {}, select, run, cancel, status, h("span.grow"), files), problem, lines), report));

  const fail = (error) => { problem.textContent = error.message; };

  async function refresh() {
    const state = await get("/api/mismatch");
    select.replaceChildren(...state.recordings.map((name) => h("option", { value: name }, name)));
    if (!state.recordings.length) select.replaceChildren(h("option", { value: "" }, `no recording in ${state.folder}`));
    show(state.job);
  }

  async function start() {
    problem.textContent = "";
    shown = "";
    report.replaceChildren();
    try { show(await post("/api/mismatch/start", { recording: select.value })); } catch (error) { fail(error); }
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
    if (running) timer = setTimeout(poll, 700);
  }

  refresh().catch(fail);
  return () => clearTimeout(timer);
}
