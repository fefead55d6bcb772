// The bar of a replay: which recording the views show, where in it, what is marked, and a second run over it.
import { download, get, post } from "./api.js";
import { canvas, css, duration, exportOptions, h } from "./dom.js";

const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 5, 10, 50];
const STEPS = 10000;

export function replayBar(link, context) {
  let mark = null; // {from, to}, seconds of the recording's own time
  const name = h("b.name");
  const play = h("button", { "aria-label": "Play", onclick: () => link.replayTo({ play: !link.replay.playing }) }, "Play");
  const speed = h("select", { "aria-label": "Speed", onchange: () => link.replayTo({ speed: Number(speed.value) }) }, SPEEDS.map((s) => h("option", { value: s }, `${s}×`)));
  const seekTo = (seconds) => link.replayTo({ seek: seconds });
  const scrub = h("input.scrub", { type: "range", min: 0, max: STEPS, step: 1, "aria-label": "Place in the recording", oninput: () => { held = performance.now(); seekTo((scrub.value / STEPS) * link.replay.length_s); } });
  const back = (seconds) => h("button", { "aria-label": `${seconds < 0 ? "Back" : "On"} ${Math.abs(seconds)} s`, onclick: () => seekTo(link.replay.position_s + seconds) }, seconds < 0 ? "−1 s" : "+1 s");
  const time = h("span.num");
  const map = canvas(drawMap, "Holds, notes and the marked span of the recording");
  const close = h("button", { onclick: () => link.replayTo({ close: true }) }, "Back to live");
  const second = h("select", { "aria-label": "Second run over it", onchange: () => link.replayTo({ second: second.value }) });
  const shift = h("input", { type: "number", step: "0.001", "aria-label": "Shift of the second run, s", title: "Seconds by which the second run is moved", onchange: () => link.replayTo({ shift: Number(shift.value) || 0 }) });
  const shiftBox = h("label", {}, "shift, s", shift);
  const marked = h("span.num.soft");
  const toMismatch = h("button", { onclick: () => act(sendToMismatch) }, "To Mismatch");
  const exportAs = h("select", { "aria-label": "Export the marked span", onchange: () => { const format = exportAs.value; exportAs.value = ""; if (format) act(() => exportSpan(format)); } });
  const clear = h("button.quiet", { onclick: () => setMark(null) }, "Clear");
  const problem = h("span.bad", { role: "alert" });
  const words = h("span.soft.words");
  let held = 0;

  const element = h("section", { id: "replay", hidden: true, "aria-label": "Replay" },
    h("div.row", {}, h("span.pill.warn", {}, "recording, not live"), name, h("span.grow"), h("label", {}, "over it", second), shiftBox, close),
    h("div.row.line", {}, play, back(-1), back(1), speed, h("div.track", {}, map, scrub), time),
    h("div.row", {}, h("button", { onclick: () => setMark({ from: now(), to: Math.max(mark?.to ?? now(), now()) }) }, "Mark start"),
      h("button", { onclick: () => setMark({ from: Math.min(mark?.from ?? start(), now()), to: now() }) }, "Mark end"), marked, toMismatch, exportAs, clear, words, problem));

  const start = () => link.replay.start_s;
  const now = () => start() + link.replay.position_s;

  async function act(work) {
    problem.textContent = "";
    try { await work(); } catch (error) { problem.textContent = error.message; }
    show(); // a replay that stands still says nothing that would take the progress of the work away
  }

  /** Mark a span in the recording's own time; null takes the mark away. */
  function setMark(span) {
    mark = span && span.to > span.from ? span : null;
    if (span && !mark) mark = { from: span.from, to: Math.min(span.from + 1, start() + link.replay.length_s) };
    show();
  }

  const path = () => `/api/recordings/${encodeURIComponent(link.replay.name)}/span`;
  async function sendToMismatch() {
    const made = await post(path(), { from_s: mark.from, to_s: mark.to, to: "mismatch" });
    await finished();
    localStorage.setItem("micron.mismatch", JSON.stringify({ recording: made.recording }));
    context.navigate("mismatch");
  }

  async function exportSpan(format) {
    const made = await post(path(), { from_s: mark.from, to_s: mark.to, to: format });
    await finished();
    await download(`/api/jobs/export/files/${encodeURIComponent(made.file)}`, made.file);
  }

  async function finished() {
    for (;;) {
      const job = await get("/api/jobs/export");
      if (job.state === "done") return;
      if (job.state !== "running") throw new Error(job.lines.at(-1) || "the span could not be cut out");
      words.textContent = `cutting the span out, ${duration(job.seconds)}`;
      await new Promise((done) => setTimeout(done, 300));
    }
  }

  async function listSecond() {
    let found;
    try { found = await get("/api/recordings"); } catch { return; }
    const names = found.recordings.filter((r) => !r.recording && r.name !== link.replay?.name).map((r) => r.name);
    second.replaceChildren(h("option", { value: "" }, "nothing"), ...names.map((n) => h("option", { value: n }, n)));
    second.value = link.replay?.second || "";
    exportAs.replaceChildren(h("option", { value: "" }, "export …"), h("option", { value: "recording" }, "recording: to open and replay"), ...exportOptions(found.formats));
  }

  function drawMap(g, w, hgt) {
    const r = link.replay;
    if (!r) return;
    const x = (t) => ((t - r.start_s) / Math.max(r.length_s, 1e-9)) * w;
    g.fillStyle = css("--grid");
    g.fillRect(0, hgt - 5, w, 5);
    g.fillStyle = css("--faint");
    g.fillRect(0, hgt - 2, w * r.progress, 2); // as far as the overview is ready
    if (mark) {
      g.fillStyle = css("--accent");
      g.globalAlpha = 0.45;
      g.fillRect(x(mark.from), 0, Math.max(2, x(mark.to) - x(mark.from)), hgt);
      g.globalAlpha = 1;
    }
    g.fillStyle = css("--warn");
    for (const { from_s, to_s } of r.holds) g.fillRect(x(from_s), 0, Math.max(2, x(to_s ?? r.start_s + r.length_s) - x(from_s)), 5);
    g.fillStyle = css("--c1");
    for (const { t_s } of r.notes) g.fillRect(x(t_s), 0, 2, hgt);
  }

  let known = "";
  function show() {
    const r = link.replay;
    element.hidden = !r;
    document.body.classList.toggle("replaying", Boolean(r));
    if (!r) { mark = null; known = ""; return; }
    if (known !== r.name) { known = r.name; mark = null; problem.textContent = ""; listSecond(); }
    name.textContent = r.name;
    play.textContent = r.playing ? "Pause" : "Play";
    play.setAttribute("aria-label", play.textContent);
    if (document.activeElement !== speed) speed.value = r.speed;
    if (performance.now() - held > 300) scrub.value = Math.round((r.position_s / Math.max(r.length_s, 1e-9)) * STEPS);
    time.textContent = `${duration(Math.floor(r.position_s))}.${String(Math.floor((r.position_s % 1) * 1000)).padStart(3, "0")} of ${duration(r.length_s)}`;
    scrub.setAttribute("aria-valuetext", `${r.position_s.toFixed(1)} s`);
    shiftBox.hidden = !r.second;
    if (document.activeElement !== shift) shift.value = r.shift_s;
    marked.textContent = mark ? `${mark.from.toFixed(2)} to ${mark.to.toFixed(2)} s` : "no span is marked";
    for (const e of [toMismatch, exportAs, clear]) e.disabled = !mark || (e !== clear && !link.mayOrder);
    const said = [r.error, r.missing.length ? `${r.missing.length} channels are not in this recording` : "",
      r.progress < 1 ? `reading the overview, ${Math.floor(100 * r.progress)} %` : "", r.lost ? r.health[0] : ""].filter(Boolean).join("; ");
    words.textContent = said;
    map.redraw();
  }

  link.on("replay", show);
  link.on("replay problem", (text) => {
    problem.textContent = text;
    if (element.hidden) context.say(text);
  });
  return { element, setMark, get mark() { return mark; } };
}
