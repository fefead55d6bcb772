// Where the time of a tick goes: one histogram per task against its budget, and from sample to command.
import { canvas, css, h } from "../dom.js";

const NAMES = { tick: "whole tick", lateness: "late by" };
const LOW_US = 1;
const HIGH_US = 20000;

const x = (us, width) => (width * Math.log(Math.max(us, LOW_US) / LOW_US)) / Math.log(HIGH_US / LOW_US);
const us = (value) => (value >= 10000 ? `${(value / 1000).toFixed(1)} ms` : `${value < 100 ? value.toFixed(1) : value.toFixed(0)}`);

export function mount(root, { link }) {
  let counts = {};
  const rows = new Map();
  const big = canvas((g, w, hgt) => histogram(g, w, hgt, counts["sample to command"], null, true), "Histogram of sample to command");
  const headline = h("div.row.headline");
  const body = h("tbody");
  const head = ["task", "rate", "distribution, log 1 µs to 20 ms", "p50", "p99", "p99.9", "worst", "budget", "over", "late", "skipped", "at tick"];
  root.append(h("div.cols.latency", {},
    h("section.panel.total", {},
      h("div", {}, h("h2", {}, "From sample to command"), headline),
      h("div.chart", {}, big)),
    h("section.panel.tasks", {}, h("h2", {}, "Tasks ", h("small", {}, "µs since the start; line: budget. “over” counts runs beyond the budget, “late” runs that ended after the deadline")),
      h("table.cards", {}, h("thead", {}, h("tr", {}, head.map((t, i) => h(i === 0 || i === 2 ? "th" : "th.num", {}, t)))), body))));

  function histogram(g, w, hgt, data, budget, axis) {
    const floor = axis ? hgt - 18 : hgt - 1;
    g.strokeStyle = css("--grid");
    g.fillStyle = css("--faint");
    g.font = `10px ${css("--mono")}`;
    for (const mark of [1, 10, 100, 1000, 10000]) {
      g.beginPath(); g.moveTo(x(mark, w), 0); g.lineTo(x(mark, w), floor); g.stroke();
      if (axis && x(mark, w) < w - 40) g.fillText(mark >= 1000 ? `${mark / 1000} ms` : `${mark} µs`, x(mark, w) + 2, hgt - 5);
    }
    if (!data?.n.length) return;
    const most = Math.log10(Math.max(...data.n) + 1);
    const [good, bad] = [css("--accent"), css("--warn")];
    data.ns.forEach((ns, i) => {
      const height = Math.max(1.5, ((floor - 2) * Math.log10(data.n[i] + 1)) / most);
      const [from, to] = [x(ns / 1000, w), x((ns + data.w[i]) / 1000, w)];
      g.fillStyle = budget && ns / 1000 >= budget ? bad : good;
      g.fillRect(from, floor - height, Math.max(1, to - from) + (axis ? -0.5 : 0.2), height);
    });
    if (budget) {
      g.strokeStyle = css("--bad");
      g.lineWidth = 1.5;
      g.beginPath(); g.moveTo(x(budget, w), 0); g.lineTo(x(budget, w), floor); g.stroke();
    }
  }

  function row(name) {
    if (rows.has(name)) return rows.get(name);
    const cells = head.slice(3).map((label) => h("td.num", { "data-label": label }));
    const picture = canvas((g, w, hgt) => histogram(g, w, hgt, counts[name], rows.get(name).budget), `Histogram of ${name}`);
    const rate = h("td.num.soft", { "data-label": "rate" });
    const line = h("tr", {}, h("td", {}, NAMES[name] || name.replaceAll("_", " ")), rate,
      h("td.picture.whole", {}, h("div.small", {}, picture)), cells);
    body.append(line);
    const made = { cells, picture, rate, budget: null };
    rows.set(name, made);
    return made;
  }

  function show(state) {
    const { timing, status } = state;
    const total = timing["sample to command"];
    if (total?.[0]) {
      const item = (name, value) => h("div", {}, h("div.faint", {}, name), h("div.big", {}, (value / 1000).toFixed(2), h("span.unit", {}, "ms")));
      headline.replaceChildren(item("p50", total[1]), item("p99", total[2]), item("worst", total[4]),
        h("div", {}, h("div.faint", {}, "skipped ticks"), h("div.big", {}, String(status.skipped ?? 0))));
    }
    for (const [name, [n, p50, p99, p999, worst, tick]] of Object.entries(timing)) {
      if (name === "sample to command") continue;
      const r = row(name);
      const task = status.tasks?.[name];
      r.budget = task?.[1] ?? null;
      r.rate.textContent = task ? `${task[0]} Hz` : "";
      const texts = n ? [us(p50), us(p99), us(p999), us(worst), task ? us(task[1]) : "", task?.[3] ?? "", task?.[4] ?? "", task?.[5] ?? "", tick] : [];
      texts.forEach((text, i) => { r.cells[i].textContent = text; });
      r.cells[1].classList.toggle("warn-text", Boolean(task && p99 > task[1]));
    }
  }

  const offs = [link.on("state", show), link.on("counts", (now) => {
    counts = now;
    big.redraw();
    rows.forEach((r) => r.picture.redraw());
  })];
  link.counts(true);
  if (link.state) show(link.state);
  return () => { offs.forEach((off) => off()); link.counts(false); };
}
