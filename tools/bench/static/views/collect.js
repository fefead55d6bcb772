// Recordings: start, stop, notes, list, quick look, export. The server records; this page may be closed.
import { download, get, post } from "../api.js";
import { bytes, colours, duration, exportOptions, h, unitText } from "../dom.js";
import { explained, figure } from "../figures.js";
import { holdSpans } from "../holds.js";
import { Strip } from "../plot.js";

const LOOKS = [["command_1,command_2,command_3", "commands"], ["tremor_x,tremor_y,tremor_z", "tremor"], ["accelerometer_1x,accelerometer_2y,accelerometer_1z", "accelerometers"], ["rate_x,rate_y,rate_z", "rates"], ["psi,theta", "angles"], ["view_x,view_y,view_size", "view"], ["accel_x,accel_y,accel_z", "accelerometers"], ["gyro_x,gyro_y,gyro_z", "rates"], ["temperature", "temperature"]];

export function mount(root, context) {
  const { link } = context;
  let chosen = null;
  const channels = new Set(context.catalogue.map((c) => c.name));
  const looks = LOOKS.filter(([value]) => value.split(",").every((name) => channels.has(name)));
  let what = looks[0][0];
  let strip = null;
  let listed = ""; // the list that is shown, as text

  const name = h("input", { type: "text", placeholder: "Name (the time if empty)", maxLength: 80, "aria-label": "Name of the recording" });
  const notes = h("input.notes", { type: "text", placeholder: "Notes", maxLength: 2000, "aria-label": "Notes" });
  const start = h("button.primary", { id: "rec-start", onclick: () => act(() => post("/api/recording/start", { name: name.value.trim(), notes: notes.value })) }, "Start recording");
  const stop = h("button", { id: "rec-stop", onclick: () => act(() => post("/api/recording/stop")) }, "Stop recording");
  const note = h("button", { onclick: () => act(async () => { await post("/api/recording/note", { text: notes.value }); notes.value = ""; }) }, "Add note");
  const status = h("span.num.soft", { id: "rec-status" });
  const problem = h("p.bad", { role: "alert", style: "margin:6px 0 0" });
  const body = h("tbody");
  const folder = h("small");
  const look = h("section.panel.fig", {}, h("p.empty", {}, "Choose a recording to look at it."));

  root.append(h("div.cols.collect", {},
    h("section.panel", {}, h("div.row", {}, start, stop, name, notes, note, status), problem),
    h("section.panel.list", {}, h("h2", {}, "Recordings ", folder),
      h("table.cards", {}, h("thead", {}, h("tr", {}, ["name", "notes"].map((t) => h("th", {}, t)), ["length", "lost", "size", "when"].map((t) => h("th.num", {}, t === "lost" ? figure(t) : t)), h("th", {}, "actions"))), body)),
    look));

  async function act(work) {
    problem.textContent = "";
    try { await work(); } catch (error) { problem.textContent = error.message; }
    refresh();
  }

  async function refresh() {
    let list;
    try { list = await get("/api/recordings"); } catch (error) { problem.textContent = error.message; return; }
    const now = JSON.stringify([list, chosen, link.mayOrder]);
    if (now === listed) return; // a button that is made anew while it is pressed does nothing
    listed = now;
    folder.textContent = list.folder;
    body.replaceChildren(...list.recordings.map((r) => h("tr", { style: r.name === chosen ? "background:var(--raised)" : "" },
      h("td.whole", {}, h("button.quiet.name", { onclick: () => show(r.name), disabled: r.recording }, r.name), r.recording ? h("span.bad", {}, " recording") : null),
      h("td.soft.notes.whole", { title: r.notes.join("\n") }, r.notes.join(" · ")),
      h("td.num", { "data-label": "length" }, r.seconds === null ? "–" : duration(r.seconds)),
      h("td.num", { className: r.dropped ? "num bad" : "num", "data-label": "lost", ...explained("lost") }, r.problem ? "!" : r.dropped ?? "–"), h("td.num", { "data-label": "size" }, bytes(r.bytes)),
      h("td.num.soft.when", { "data-label": "when" }, new Date(r.modified * 1000).toLocaleString([], { dateStyle: "short", timeStyle: "short" })),
      h("td.whole", {}, r.recording ? null : h("div.row", {}, actions(r, list))))));
    if (!list.recordings.length) body.replaceChildren(h("tr", {}, h("td.soft.whole", { colSpan: 7 }, "None yet. Start one above; it goes on when this page is closed.")));
  }

  function actions(r, list) {
    const path = `/api/recordings/${encodeURIComponent(r.name)}`;
    const formats = h("select", { "aria-label": `Export ${r.name}`, onchange: () => { (formats.value === "recover" ? recover(path) : exportAs(path, formats.value)); formats.value = ""; } },
      h("option", { value: "" }, "export …"), exportOptions(list.formats),
      link.mayOrder ? h("option", { value: "recover" }, "recover: a torn file made whole") : null);
    let sure = false;
    const remove = h("button.quiet", { disabled: !link.mayOrder, onclick: () => {
      if (sure) act(() => post(`${path}/delete`));
      else { sure = true; remove.textContent = "Really delete?"; remove.classList.add("bad"); }
    } }, "Delete");
    return [h("button", { onclick: () => { link.replayTo({ name: r.name }); context.navigate("scope"); } }, "Open"), h("button.quiet", { onclick: () => act(() => download(`${path}/file`, `${r.name}.mcap`)) }, "Download"), formats, remove];
  }

  /** The job when it is done; an Error with its last line when it failed. */
  async function ended(kind) {
    for (;;) {
      const job = await get(`/api/jobs/${kind}`);
      if (job.state === "done") return job;
      if (job.state !== "running") throw new Error(job.lines.at(-1) || `${kind} failed`);
      await new Promise((resolve) => setTimeout(resolve, 300));
    }
  }

  async function exportAs(path, format) {
    if (!format) return;
    await act(async () => {
      await post(`${path}/export`, { format });
      const { files: [file] } = await ended("export");
      await download(`/api/jobs/export/files/${encodeURIComponent(file)}`, file);
    });
  }

  /** A torn file is made whole beside itself, and looked at: what is missing is said there. */
  async function recover(path) {
    await act(async () => {
      const { recording } = await post(`${path}/recover`);
      await ended("recover");
      show(recording);
    });
  }

  async function show(which) {
    chosen = which;
    strip?.destroy();
    strip = null;
    look.replaceChildren(h("p.empty", {}, `Reading ${which} …`));
    let data;
    try { data = await get(`/api/recordings/${encodeURIComponent(which)}/look?channels=${what}`); } catch (error) { look.replaceChildren(h("p.empty.bad", {}, error.message)); return; }
    const palette = colours();
    strip = new Strip(data.channels.map((label, i) => ({ label, unit: data.units[i], colour: palette[i] })), { xTitle: "time, s", yTitle: unitText(data.units[0] || "1") });
    const x = Float64Array.from(data.t.flatMap((t) => [t, t]));
    const ys = data.low.map((low, c) => Float32Array.from(low.flatMap((v, i) => [v, data.high[c][i]])));
    const picker = h("select", { "aria-label": "What to look at", onchange: () => { what = picker.value; show(which); } }, looks.map(([value, title]) => h("option", { value, selected: value === what }, title)));
    look.replaceChildren(h("h2", {}, which, picker), strip.element, h("p.note", { className: data.lost ? "note bad" : "note" }, data.health.join(" · ")));
    strip.show(x, ys, x[0], x[x.length - 1], null, holdSpans(data.holds, 0, x[0], x[x.length - 1]));
    refresh();
  }

  const off = link.on("state", (state) => {
    const on = Boolean(state.recording);
    if (stop.disabled === on) refresh();
    start.disabled = on || !link.mayOrder || state.phase !== "running";
    stop.disabled = !on || !link.mayOrder;
    note.disabled = !on || !link.mayOrder;
    status.textContent = on ? `${state.recording.name}: ${duration(state.recording.seconds)}, ${state.recording.written} ticks written, ${state.recording.dropped} lost` : `${bytes(state.disk.free)} free`;
  });
  refresh();
  const offServer = link.on("server", refresh);
  return () => { off(); offServer(); strip?.destroy(); };
}
