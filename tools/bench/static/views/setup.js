// A bench file for a new bench: what is plugged in, which input is which axis, live volts, and what doctor says of it.
import { get, post } from "../api.js";
import { digits, h } from "../dom.js";

const VOLTS = [0, 1, 2, 3, 4, 5, 6, 7].map((i) => `volts_${i}`);
const BUSES = [["daq0", "serial", "converter of the accelerometers"], ["i2c0", "i2c", "outputs"], ["e7270", "serial", "controller of the outputs"], ["i2c1", "i2c", "slow converters"], ["can0", "can", "telemetry, or the node of the outputs"]];
const PARTS = [["piezo", "i2c0", 0x0c, "DAC of the outputs"], ["magnetometer", "i2c1", 0x48, "converter of the magnetometer"], ["monitor", "i2c1", 0x49, "converter of the monitor"]];
const hex = (v) => `0x${v.toString(16).padStart(2, "0").toUpperCase()}`;

export function mount(root, { link, navigate, catalogue }) {
  const hasVolts = catalogue.some((c) => c.name === VOLTS[0]); // an instrument without a converter has none
  const subscription = hasVolts ? link.subscribe(VOLTS, 200, 200, 2) : null;
  const inputs = { "1x": 0, "1z": 1, "2y": 2, "2z": 3, "3x": 4, "3y": 5, supply: 6, temperature: 7 };
  const problem = h("p.bad", { role: "alert" });
  const fail = (error) => { problem.textContent = error.message; };
  const act = async (work) => {
    problem.textContent = "";
    try { await work(); } catch (error) { fail(error); }
  };
  let written = "";

  const name = h("input", { type: "text", maxLength: 80, value: "my bench", "aria-label": "Name of the bench" });
  const uriFields = Object.fromEntries(BUSES.map(([bus, kind]) => {
    const field = h("input", { type: "text", maxLength: 100, "aria-label": `Address of ${bus}` });
    field.setAttribute("list", `found-${kind}`);
    return [bus, field];
  }));
  const uriRows = Object.fromEntries(BUSES.map(([bus, , what]) => [bus, h("label", {}, h("span", {}, h("b", {}, bus), ` ${what}`), uriFields[bus])]));
  const lists = h("div", { hidden: true });
  const known = h("div.soft.num");
  const answers = h("div.num.soft", { role: "status" });
  const scanButton = h("button", { title: "Reads a byte from each I2C address; listens to CAN for two seconds", onclick: () => act(scan) }, "Scan I2C and CAN");

  // what the bench has: a converter, an output, and what may be left out
  const daq = h("select", { "aria-label": "Converter of the accelerometers", onchange: () => showNeeded() });
  const output = h("select", { "aria-label": "Outputs", onchange: () => showNeeded() });
  const card = (what, value) => h("input.unit-field", { type: "text", maxLength: 60, value, "aria-label": `NI card of the ${what}` });
  const cards = { daq: card("converter", "Dev1"), output: card("outputs", "Dev2") };
  const has = {};
  const byHand = new Set(); // parts that a person ticked or left out while a scan was running: the scan does not
  const addresses = {};
  const partRows = Object.fromEntries(PARTS.map(([part, bus, address, what]) => {
    has[part] = h("input", { type: "checkbox", checked: true, disabled: part === "piezo", "aria-label": `The bench has: ${what}`, onchange: () => { byHand.add(part); showNeeded(); } });
    addresses[part] = h("input.unit-field", { type: "text", value: hex(address), "aria-label": `Address of the ${what}` });
    return [part, h("div.part", {}, h("label", {}, has[part], what), h("label.faint", {}, `${bus} at`, addresses[part]))];
  }));
  const telemetry = h("input", { type: "checkbox", checked: true, "aria-label": "The bench has: telemetry on CAN", onchange: () => showNeeded() });
  const parts = [h("div.set", {}, h("label", {}, h("span", {}, h("b", {}, "converter"), " of the accelerometers"), daq, cards.daq), h("label", {}, h("span", {}, h("b", {}, "outputs")), output, cards.output)),
    ...Object.values(partRows), h("div.row", {}, h("label", {}, telemetry, "telemetry on CAN"))];
  let outputBus = {};

  /** The buses that the chosen parts hang on; the fields of the others go. */
  function neededBuses() {
    return BUSES.map(([bus]) => bus).filter((bus) => bus === outputBus[output.value] || (bus === "daq0" && daq.value === "di4108")
      || (bus === "i2c1" && (has.magnetometer.checked || has.monitor.checked)) || (bus === "can0" && telemetry.checked));
  }
  function showNeeded() {
    const needed = neededBuses();
    for (const [bus] of BUSES) uriRows[bus].hidden = !needed.includes(bus);
    partRows.piezo.hidden = output.value !== "dac_amplifier";
    for (const part of ["magnetometer", "monitor"]) addresses[part].disabled = !has[part].checked;
    cards.daq.hidden = daq.value !== "nidaqmx";
    cards.output.hidden = output.value !== "nidaqmx_ao";
  }

  // channels: dragged to places, or chosen there
  const selects = {};
  const live = VOLTS.map(() => h("b.num"));
  const chips = VOLTS.map((_, i) => {
    const chip = h("div.chip", { draggable: true, title: "Drag it to what it is wired to" }, `input ${i}`, live[i]);
    chip.addEventListener("dragstart", (event) => event.dataTransfer.setData("text/plain", String(i)));
    return chip;
  });
  const shownIn = {};
  const places = Object.keys(inputs).map((place) => {
    selects[place] = h("select", { "aria-label": `Input of ${place}`, onchange: () => give(place, Number(selects[place].value)) }, VOLTS.map((_, i) => h("option", { value: i }, `input ${i}`)));
    shownIn[place] = h("b.num");
    const title = /^\d/.test(place) ? `accelerometer ${place[0]}, axis ${place[1]}` : place;
    const slot = h("div.slot", {}, h("span", {}, title), selects[place], shownIn[place]);
    slot.dataset.place = place;
    slot.addEventListener("dragover", (event) => { event.preventDefault(); slot.classList.add("dropping"); });
    slot.addEventListener("dragleave", () => slot.classList.remove("dropping"));
    slot.addEventListener("drop", (event) => {
      event.preventDefault();
      slot.classList.remove("dropping");
      const input = Number(event.dataTransfer.getData("text/plain"));
      if (VOLTS[input]) give(place, input);
    });
    return slot;
  });

  /** Each input is for one place: the place that had it gets the other's. */
  function give(place, input) {
    const other = Object.keys(inputs).find((p) => inputs[p] === input);
    if (other && other !== place) inputs[other] = inputs[place];
    inputs[place] = input;
    for (const [p, select] of Object.entries(selects)) select.value = inputs[p];
  }
  give("1x", 0);

  async function scan() {
    const said = [];
    byHand.clear();
    scanButton.disabled = true;
    try {
      // a bus may have parts that the bench was not told of: i2c1 is asked also when nothing is ticked there
      for (const bus of new Set([...neededBuses(), "i2c1"])) {
        const uri = uriFields[bus].value.trim();
        if (!uri || bus === "daq0" || bus === "e7270") continue;
        answers.textContent = `asking ${uri} …`;
        const found = await post("/api/setup/scan", { uri });
        const names = found.kind === "can" ? found.frames.map(([id, name, hz]) => `${hex(id)} ${name === "?" ? "" : `${name} `}${digits(hz, 3)}/s`) : found.addresses.map(hex);
        said.push(h("div", {}, `${uri}: ${names.join(", ") || (found.kind === "can" ? "no frame within two seconds" : "nobody answers")}`));
        for (const [part, on] of PARTS) if (on === bus && part !== "piezo" && !byHand.has(part)) has[part].checked = found.addresses.includes(Number(addresses[part].value));
      }
    } finally {
      scanButton.disabled = !link.mayOrder;
      answers.replaceChildren(...said);
      showNeeded();
    }
  }

  function draft() {
    const address = (part) => (has[part].checked ? Number(addresses[part].value) : null);
    return {
      name: name.value.trim(), inputs, daq: daq.value, daq_card: cards.daq.value, output: output.value, output_card: cards.output.value,
      piezo: address("piezo"), magnetometer: address("magnetometer"), monitor: address("monitor"), telemetry: telemetry.checked,
      uris: Object.fromEntries(neededBuses().map((bus) => [bus, uriFields[bus].value.trim()])),
    };
  }

  const findings = h("div");
  const content = h("pre.num.lines", { tabIndex: 0, role: "region", "aria-label": "The bench file" });
  function show({ text, findings: list }) {
    content.textContent = text;
    const colour = { ok: "good-text", limited: "warn-text", missing: "bad" };
    findings.replaceChildren(...list.map((f) => h("div", {}, h("b", { className: colour[f.verdict] || "" }, f.verdict), ` ${f.part}: ${f.detail}${f.remedy ? `; ${f.remedy}` : ""}`)));
  }
  const check = h("button", { onclick: () => act(async () => show(await post("/api/setup/check", draft()))) }, "Check");
  const write = h("button.primary", { onclick: () => act(async () => {
    const made = await post("/api/setup/write", draft());
    written = made.path;
    show(made);
    enable();
  }) }, "Write the bench file");
  const attempt = h("button", { title: "The firmware starts again with this file; nothing is armed", onclick: () => act(() => post("/api/setup/try", { path: written })) }, "Try it: sensing only");
  const folder = h("small");
  const benches = h("select", { "aria-label": "Bench to run", onchange: () => act(askCompiled) });
  const compiled = h("input", { type: "checkbox", disabled: true });
  const whyNot = h("p.note", { role: "status" });
  let canCompile = false;
  const runIt = h("button", { title: "Ends what runs, in its safe state, and starts this bench", onclick: () => act(() => post("/api/firmware/start", { bench: benches.value, compiled: compiled.checked })) }, "Run it");

  root.append(h("div.cols.setup", {},
    h("section.panel", {}, h("h2", {}, "Buses ", h("small", {}, "what this machine has is offered")),
      h("div.set", {}, Object.values(uriRows)), lists, known,
      h("div.row", {}, scanButton, h("button.quiet", { title: "Look again for what is plugged in", onclick: () => act(refresh) }, "Look again")), answers,
      h("h2", { style: "margin-top:12px" }, "Parts ", h("small", {}, "leave out what the bench lacks")), parts),
    h("section.panel", {}, h("h2", {}, "Inputs ", h("small", {}, "drag each to what it is wired to; volts of the running bench")),
      h("div.wiring", {}, h("div.chips", {}, chips), h("div.slots", {}, places)),
      h("p.note", {}, "Tilt or tap one sensor: the volts that move are its own.")),
    h("section.panel", {}, h("h2", {}, "Bench file ", folder),
      h("div.row", {}, h("label", {}, "name", name), check, write, attempt, h("button.quiet", { onclick: () => navigate("scope") }, "See it in the scope")), h("div.row", {}, h("label", {}, "another bench", benches), h("label", { title: "The ticks run in one compiled thread without the interpreter, on the wall clock" }, compiled, "compiled"), runIt), whyNot, problem, findings, content)));

  function enable() {
    for (const button of [check, write, scanButton, runIt]) button.disabled = !link.mayOrder;
    attempt.disabled = !link.mayOrder || !written;
    compiled.disabled = !link.mayOrder || !canCompile;
  }

  /** A bench whose devices cannot run compiled says which device and why. */
  async function askCompiled() {
    const asked = benches.value;
    canCompile = false;
    enable();
    const { why } = await get(`/api/benches/compiled?bench=${encodeURIComponent(asked)}`);
    if (asked !== benches.value) return; // another one was chosen meanwhile
    canCompile = !why;
    if (why) compiled.checked = false;
    whyNot.textContent = why;
    enable();
  }

  async function refresh() {
    const found = await get("/api/setup");
    folder.textContent = `written into ${found.folder}`;
    lists.replaceChildren(...["serial", "i2c", "can"].map((kind) => h("datalist", { id: `found-${kind}` }, Object.entries(found[kind]).map(([uri, what]) => h("option", { value: uri, label: what ? `${uri} ${what}` : uri })))));
    const plugged = Object.entries({ ...found.serial, ...found.i2c, ...found.can }).filter(([uri]) => !uri.startsWith("sim:"));
    known.replaceChildren(...plugged.map(([uri, what]) => h("div", {}, what ? `${uri}: ${what}` : uri)));
    for (const [kind, buses] of [["serial", ["daq0", "e7270"]], ["i2c", ["i2c0", "i2c1"]], ["can", ["can0"]]]) {
      const uris = Object.keys(found[kind]);
      buses.forEach((bus, k) => { if (!uriFields[bus].value) uriFields[bus].value = uris[Math.min(k, uris.length - 1)] || ""; });
    }
    if (!daq.options.length) {
      daq.append(...Object.entries(found.daqs).map(([key, title]) => h("option", { value: key }, title)));
      output.append(...Object.entries(found.outputs).map(([key, [title]]) => h("option", { value: key }, title)));
      outputBus = Object.fromEntries(Object.entries(found.outputs).map(([key, [, bus]]) => [key, bus]));
    }
    const others = await get("/api/benches");
    benches.replaceChildren(...others.benches.map((path) => h("option", { value: path, selected: path === others.now }, path.split("/").pop())));
    compiled.checked = Boolean(link.state?.compiled) && benches.value === others.now;
    showNeeded();
    enable();
    await askCompiled();
  }

  const timer = setInterval(() => {
    const b = subscription?.buckets;
    if (!b?.n) return;
    VOLTS.forEach((_, i) => { live[i].textContent = `${digits(b.last(i), 4)} V`; });
    for (const [place, input] of Object.entries(inputs)) shownIn[place].textContent = `${digits(b.last(input), 4)} V`;
  }, 150);
  const offState = link.on("state", enable);
  const offServer = link.on("server", () => refresh().catch(fail));
  enable();
  refresh().catch(fail);
  window.micron.setup = { inputs, give };
  return () => { clearInterval(timer); offState(); offServer(); link.drop(subscription); };
}
