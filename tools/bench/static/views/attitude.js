// The instrument in space, its numbers, its drift, and another filter beside it.
import { get, post } from "../api.js";
import { canvas, css, digits, h, persistent } from "../dom.js";
import { explained, figure } from "../figures.js";
import { holdSpans } from "../holds.js";
import { Strip, interleave, times } from "../plot.js";
import { angleBetween, drawInstrument, euler, orbit } from "../solid.js";

const QUATERNION = ["quaternion_w", "quaternion_x", "quaternion_y", "quaternion_z"];

function palette() {
  const dark = document.documentElement.dataset.theme === "dark";
  return {
    parts: dark ? [[126, 146, 156], [208, 219, 224], [236, 205, 140]] : [[120, 138, 150], [214, 222, 228], [214, 170, 80]],
    mark: [45, 212, 191], grid: css("--grid"), soft: css("--soft"), accent: css("--accent"), mono: css("--mono"),
    x: css("--c7"), y: css("--c3"), z: css("--c1"),
  };
}

const NUMBERS = [["roll", "roll (x)"], ["pitch", "pitch (y)"], ["yaw", "yaw (z)"], ["quaternion", "q w, x"], ["quaternion", "q y, z"], ["turned since zero"]];

export function mount(root, { link, catalogue }) {
  const settings = persistent("attitude", { compare: "" });
  const rates = catalogue.filter((c) => c.unit === "rad/s").slice(0, 3).map((c) => c.name);
  const subscription = link.subscribe(QUATERNION, 100, 100);
  const history = link.subscribe(rates, 10 * link.rateHz, 600);
  let colours = palette();
  let reference = null;
  let q = null;
  let other = null;

  const main = canvas((g, w, hgt) => q && drawInstrument(g, w, hgt, q, colours, reference), "Instrument in space");
  const second = canvas((g, w, hgt) => other && drawInstrument(g, w, hgt, other, colours, q), "Instrument in space, other filter");
  [main, second].forEach(orbit);
  const title = h("h2", {}, "Firmware");
  const choice = h("select", { "aria-label": "Filter beside it", onchange: () => compare(choice.value) });
  const gap = h("span.num.soft.what", { tabIndex: 0, ...explained("apart") });
  const use = h("button", { id: "use-filter", onclick: () => change(() => post("/api/filters/use", { method: choice.value })) }, "Use it in the firmware");
  const back = h("button", { hidden: true, onclick: () => change(() => post("/api/calibrate/discard")) }, "Back to the original bench");
  const secondPanel = h("section.panel.fig", { hidden: true },
    h("h2", {}, "Beside it: ", gap), h("div.chart.square", {}, second));
  const numbers = h("table");
  const error = h("p.note");
  const beside = h("section.panel", { hidden: true }, h("h2", {}, "Compare with"), h("div.row", {}, choice, use, back), error,
    h("p.note", {}, "It runs in the server on the same raw samples. Drag a picture to turn it."));
  const strip = new Strip(["x", "y", "z"].map((a) => ({ label: `rate ${a}`, unit: "°/s" })), { least: 2, xTitle: "time, s", yTitle: "°/s" });

  async function compare(method) {
    settings.compare = method;
    settings.save();
    error.textContent = "";
    try { await post("/api/compare", { method }); } catch (problem) { error.textContent = problem.message; }
  }

  /** The firmware starts again: with another filter, or as the bench file says. */
  async function change(work) {
    error.textContent = "";
    try { await work(); } catch (problem) { error.textContent = problem.message; }
  }

  let running = "";
  let known = "";
  async function listFilters() {
    const found = await get("/api/filters");
    running = found.running;
    beside.hidden = found.methods.length < 2;
    title.replaceChildren("Firmware: ", h("b", { style: "color:var(--text)" }, running));
    if (!choice.options.length) choice.replaceChildren(h("option", { value: "" }, "nothing"), ...found.methods.map((m) => h("option", { value: m }, m)));
    choice.value = link.state?.shadow || "";
    back.hidden = !found.applied.includes("attitude filter");
  }
  const offState = link.on("state", (state) => {
    const now = `${state.run} ${state.phase === "running"}`;
    if (now !== known) { known = now; listFilters().catch(() => {}); }
    use.disabled = !link.mayOrder || !choice.value || choice.value === running;
    back.disabled = !link.mayOrder;
  });

  root.append(h("div.cols.attitude", {},
    h("div.stack.solids", {}, h("section.panel.fig", {}, title, h("div.chart.square", {}, main)), secondPanel),
    h("div.stack.side", {},
      h("section.panel", {}, h("h2", {}, "Attitude ", h("small", {}, "body to world")), numbers,
        h("div.row", { style: "margin-top:10px" }, h("button", { onclick: () => { reference = q; } }, "Zero the drift here"))),
      beside),
    h("div.strips", {}, strip.element)));

  let frame = 0;
  let turn = 0;
  function draw() {
    frame = requestAnimationFrame(draw);
    if (++turn % 2) return; // 30 pictures a second are enough here
    const b = subscription.buckets;
    if (b.n) {
      q = [0, 1, 2, 3].map((c) => b.last(c));
      const size = Math.hypot(...q);
      if (size < 0.5) q = null;
      if (q && !reference) reference = q;
    }
    const method = link.replay ? "" : link.state?.shadow; // it follows the bench, not a recording
    secondPanel.hidden = !method;
    other = method && link.shadow && Math.hypot(...link.shadow) > 0.5 ? link.shadow : null;
    main.redraw();
    if (q && other) {
      second.redraw();
      gap.textContent = `${method}, ${digits((angleBetween(q, other) * 180) / Math.PI, 3)}° apart`;
    }
    if (history.buckets.n) {
      const t = history.buckets.times();
      const end = t[t.length - 1];
      strip.show(times(history.buckets, end), [0, 1, 2].map((c) => interleave(history.buckets, c, 180 / Math.PI)), -10, 0, null, holdSpans(link.holds, end, -10, 0));
    }
  }
  const offServer = link.on("server", () => { // the filter beside it ran in the server that is gone
    known = "";
    if (settings.compare && link.mayOrder) compare(settings.compare);
  });
  const cells = NUMBERS.map(() => h("td.num")); // they stay: what is pointed at keeps its explanation
  const timer = setInterval(() => {
    if (!q || !reference) return; // a new run has not shown its first sample yet
    const [roll, pitch, yaw] = euler(q);
    const values = [`${roll.toFixed(2)}°`, `${pitch.toFixed(2)}°`, `${yaw.toFixed(2)}°`,
      `${q[0].toFixed(5)}  ${q[1].toFixed(5)}`, `${q[2].toFixed(5)}  ${q[3].toFixed(5)}`,
      `${((angleBetween(reference, q) * 180) / Math.PI).toFixed(3)}°`];
    if (!numbers.contains(cells[0])) numbers.replaceChildren(...NUMBERS.map(([name, text], i) => h("tr", {}, h("td.soft", {}, figure(name, text)), cells[i])));
    values.forEach((value, i) => { cells[i].textContent = value; });
  }, 100);
  const retheme = () => { colours = palette(); strip.build(); };
  window.addEventListener("themechange", retheme);
  const offRun = link.on("run", ({ same }) => { if (!same) q = reference = null; });
  const offSource = link.on("source", () => { q = reference = null; });
  draw();
  return () => {
    cancelAnimationFrame(frame);
    clearInterval(timer);
    window.removeEventListener("themechange", retheme);
    offRun();
    offServer();
    offSource();
    offState();
    link.drop(subscription);
    link.drop(history);
    strip.destroy();
    if (link.state?.shadow && link.mayOrder) post("/api/compare", { method: "" }).catch(() => {});
  };
}
