// A data file of one's own: dropped, its columns drawn and named, its twin described, written as a recording.
import { get, post, put } from "../api.js";
import { bytes, canvas, css, digits, h } from "../dom.js";

const ROLES = [["time", "time"], ["input", "input"], ["output", "output"], ["context", "context"], ["", "not used"]];
const NOTES = {
  columns: ". Another program worked the outputs out: beside each output stands an input named simulated_ and the output's signal",
  instrument: ". Signals: command_1 to command_3, path_, tip_, angle_ and volts_0 to volts_7; the bench file is copied beside the data",
  fmu: ". The FMU lies in the folder of the recordings and is copied beside the data; before it runs, “micron trust FILE” is needed once",
};
const EXAMPLES = { "[xyz]": ["x", "y", "z"] };

/** The words that a twin has for a role: patterns become examples. */
export function wordsOf(kind, role, outputs = []) {
  if (kind?.kind === "columns" && role === "input") return outputs.map((output) => `simulated_${output}`);
  const known = role === "input" ? kind?.inputs : role === "output" ? kind?.outputs : [];
  return (known || []).flatMap(([pattern]) => (pattern.endsWith("[xyz]") && !pattern.includes("\\")
    ? EXAMPLES["[xyz]"].map((axis) => pattern.replace("[xyz]", axis)) : pattern.includes("\\") ? [] : [pattern]));
}

export function newRecording(link, done) {
  let file = null; // what the server said of the dropped file
  let kinds = [];
  let suffixes = [];
  let most = 200 * 2 ** 20;
  let busy = false;
  const problem = h("p.bad", { role: "alert" });
  const pick = h("input", { type: "file", hidden: true, "aria-label": "Data file", onchange: () => { const [f] = pick.files; pick.value = ""; take(f); } });
  const open = h("button", { onclick: () => pick.click() }, "Open a file …");
  const form = h("section.panel.new-recording", { hidden: true, "aria-label": "Describe the file" });
  const wrong = h("p.bad", { role: "alert" }); // of the form
  const fail = (error) => { problem.textContent = error.message; problem.scrollIntoView({ block: "nearest" }); };

  async function take(chosen) {
    if (!chosen || busy) return;
    problem.textContent = wrong.textContent = ""; // one message: of what was done last
    if (!link.mayOrder) { fail(new Error("View only: a file needs the address that “micron bench” printed.")); return; }
    try {
      ({ kinds, most_bytes: most, suffixes } = await get("/api/mismatch/kinds"));
    } catch (error) { fail(error); return; }
    if (!suffixes.some((s) => chosen.name.toLowerCase().endsWith(s))) { fail(new Error(`${chosen.name}: a file must be ${suffixes.join(", ")}.`)); return; }
    if (chosen.size > most) {
      fail(new Error(`${chosen.name} has ${bytes(chosen.size)}; the page takes ${bytes(most)}. Put it into a folder of the recordings with a recording.toml beside it.`));
      return;
    }
    busy = true;
    open.textContent = `Reading ${chosen.name} …`;
    try {
      const found = await put(`/api/upload/${encodeURIComponent(chosen.name)}`, chosen);
      if (found.recording) { done(found.recording); return; }
      file = found;
      build();
    } catch (error) { fail(error); } finally {
      busy = false;
      open.textContent = "Open a file …";
    }
  }

  function drawn(column, i) {
    return canvas((g, w, hgt) => {
      const [low, high] = [Math.min(...column.low), Math.max(...column.high)];
      const y = (v) => hgt - 3 - ((hgt - 6) * (v - low)) / (high - low || 1);
      g.strokeStyle = css(`--c${1 + (i % 8)}`);
      g.lineWidth = 1.2;
      g.beginPath();
      column.low.forEach((v, k) => {
        const x = (w * (k + 0.5)) / column.low.length;
        g.lineTo(x, y(v));
        g.lineTo(x, y(column.high[k]));
      });
      g.stroke();
    }, `Picture of ${column.name}`);
  }

  /** A file of this machine that the twin needs. */
  const fileChoice = (key, files) => h("select", { title: key.help, "aria-label": key.name }, files.length ? files.map((f) => h("option", { value: f }, f)) : h("option", { value: "" }, "none is there"));

  function build() {
    const name = h("input", { type: "text", maxLength: 80, value: file.name.replace(/\.[^.]+$/, "").replace(/[^A-Za-z0-9._ -]/g, "_"), "aria-label": "Name of the recording" });
    const rate = h("input", { type: "number", step: "any", min: 0, value: file.rate_hz ? Number(file.rate_hz.toPrecision(9)) : "", placeholder: "samples a second", "aria-label": "Rate, Hz" });
    const kind = h("select", { "aria-label": "Kind of twin", onchange: () => showKind() }, h("option", { value: "" }, "choose …"), kinds.map((k) => h("option", { value: k.kind, selected: k.kind === file.kind }, k.kind.replaceAll("_", " "))));
    const lists = h("div", { hidden: true });
    const chosen = () => kinds.find((k) => k.kind === kind.value);
    const rows = file.columns.map((column, i) => {
      const role = h("select", { "aria-label": `Role of ${column.name}`, onchange: () => { showRole(); showWords(); } }, ROLES.map(([value, text]) => h("option", { value, selected: value === column.role }, text)));
      const signal = h("input", { type: "text", value: column.signal, maxLength: 100, "aria-label": `Signal of ${column.name}` });
      signal.setAttribute("list", `words-${column.role}`);
      const unit = h("input.unit-field", { type: "text", value: column.unit, maxLength: 30, placeholder: "V, um, N …", "aria-label": `Unit of ${column.name}` });
      const noise = h("input.unit-field", { type: "number", step: "any", min: 0, placeholder: "if any", "aria-label": `Noise of ${column.name}` });
      const showRole = () => {
        signal.setAttribute("list", `words-${role.value}`);
        for (const e of [signal, unit]) e.disabled = ["", "time"].includes(role.value);
        noise.disabled = role.value !== "output";
      };
      signal.addEventListener("change", () => { if (kind.value === "columns") showWords(); });
      showRole();
      const range = `${digits(Math.min(...column.low), 3)} to ${digits(Math.max(...column.high), 3)}`;
      return { column, role, signal, unit, noise, element: h("tr", {},
        h("td.whole", {}, h("b", {}, column.name), h("div.faint.num", {}, range)), h("td.picture.whole", {}, h("div.small", {}, drawn(column, i))),
        h("td", { "data-label": "role" }, role), h("td", { "data-label": "signal" }, signal), h("td", { "data-label": "unit" }, unit), h("td", { "data-label": "noise, rms" }, noise)) };
    });
    const parameters = h("div.set");
    const others = h("textarea", { rows: 2, maxLength: 2000, placeholder: "name = value, one a line", "aria-label": "Other parameters" });
    const othersName = h("b");
    const othersBox = h("label", {}, h("span", {}, othersName), others);
    const known = h("p.note");
    let fields = [];

    function showKind() {
      const k = chosen();
      fields = (k?.keys || []).map((key) => ({ key, field: key.name === k.file_key ? fileChoice(key, k.files) : h("input", { type: "text", maxLength: 2000, placeholder: key.default ? `if empty: ${key.default}` : "needed", title: `${key.help}: ${key.value}`, "aria-label": key.name }) }));
      parameters.replaceChildren(...fields.map(({ key, field }) => h("label", {}, h("span", {}, h("b", {}, key.name), " ", key.help), field)), othersBox);
      othersBox.hidden = !k?.others;
      othersName.textContent = k?.others || "";
      known.textContent = !k ? "The kind says which physics the twin starts from." : [["inputs", k.inputs], ["outputs", k.outputs]]
        .map(([role, words]) => `${role}: ${words.length ? words.map(([p, u]) => `${p} (${u.join(" or ")})`).join(", ") : "any names and units"}`).join("; ") + (NOTES[k.kind] || "");
      showWords();
    }

    function showWords() {
      const outputs = rows.filter((r) => r.role.value === "output").map((r) => r.signal.value.trim());
      lists.replaceChildren(...ROLES.map(([role]) => h("datalist", { id: `words-${role}` }, wordsOf(chosen(), role, outputs).map((w) => h("option", { value: w })))));
    }

    async function make() {
      problem.textContent = wrong.textContent = "";
      const used = rows.filter((r) => ["input", "output", "context"].includes(r.role.value));
      const clock = rows.find((r) => r.role.value === "time")?.column.name || "";
      try {
        const made = await post("/api/mismatch/new", {
          number: file.number, name: name.value.trim(), title: file.name, kind: kind.value, time_column: clock, ...(!clock && rate.value ? { rate_hz: Number(rate.value) } : {}),
          others: othersBox.hidden ? "" : others.value, parameters: Object.fromEntries(fields.map(({ key, field }) => [key.name, field.value])),
          channels: used.map((r) => ({ column: r.column.name, role: r.role.value, signal: r.signal.value.trim(), unit: r.unit.value.trim(), ...(r.noise.value ? { noise_rms: Number(r.noise.value) } : {}) })),
        });
        form.hidden = true;
        file = null;
        done(made.recording);
      } catch (error) {
        wrong.textContent = error.message;
        wrong.scrollIntoView({ block: "nearest" });
      }
    }

    /** What the guess could not know, assumed and left out. */
    const remarks = () => [["Repair the file first, or let “micron mismatch new FILE --cut” do it: ", file.broken], ["Say what could not be known: ", file.unknown], ["Assumed: ", file.assumed], ["", file.notes]]
      .filter(([, said]) => said.length).map(([head, said]) => h("p.note", {}, `${head}${said.join("; ")}.`));

    showKind();
    form.hidden = false;
    form.replaceChildren(h("h2", {}, `${file.name} `, h("small", {}, `${file.samples} samples`), h("span.grow"), h("button.quiet", { onclick: () => { form.hidden = true; file = null; } }, "Discard")),
      ...remarks(),
      h("table.cards", {}, h("thead", {}, h("tr", {}, ["column", "", "role", "signal", "unit", "noise, rms"].map((t) => h("th", {}, t || h("span.unseen", {}, "picture"))))), h("tbody", {}, rows.map((r) => r.element))), lists,
      h("div.row", {}, h("label", {}, "twin", kind), h("label", {}, "rate without a time column, Hz", rate)), known, parameters,
      h("div.row", {}, h("label", {}, "name", name), h("button.primary", { onclick: make }, "Make the recording and diagnose")), wrong);
    form.scrollIntoView({ block: "nearest" });
  }

  /** Files dropped on `zone` are taken. */
  function dropOn(zone) {
    const over = (on) => (event) => { event.preventDefault(); zone.classList.toggle("dropping", on); };
    zone.addEventListener("dragover", over(true));
    zone.addEventListener("dragleave", over(false));
    zone.addEventListener("drop", (event) => { over(false)(event); take(event.dataTransfer.files[0]); });
  }

  return { open, pick, form, problem, dropOn, take };
}
