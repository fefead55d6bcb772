// Where the time of a tick goes: one histogram per task against its budget, and the whole way of a sample.
import { canvas, css, h } from "../dom.js";
import { explained, figure } from "../figures.js";

const NAMES = { tick: "whole tick", lateness: "late by" };
const LOW_US = 1;
const HIGH_US = 20000;

const x = (us, width) => (width * Math.log(Math.max(us, LOW_US) / LOW_US)) / Math.log(HIGH_US / LOW_US);
const us = (value) => (value >= 10000 ? `${(value / 1000).toFixed(1)} ms` : `${value < 100 ? value.toFixed(1) : value.toFixed(0)}`);

/** p99 as a share of the budget: a bar of which two thirds are 100 %, with a line there. */
function budgetBar() {
  const fill = h("i");
  const text = h("span");
  const bar = h("div.budget", {}, h("div.track", {}, fill, h("b")), text);
  bar.show = (share) => {
    fill.style.width = `${Math.min(100, (100 * share) / 1.5)}%`;
    fill.classList.toggle("over", share > 1);
    text.textContent = `${(100 * share).toFixed(0)} %`;
  };
  return bar;
}

export function mount(root, { link }) {
  let counts = {};
  let own = "sample to command"; // the instrument's own histogram, beside those of its tasks
  const ownTitle = h("h2", {}, "From sample to command");
  const rows = new Map();
  const big = canvas((g, w, hgt) => histogram(g, w, hgt, counts[own], null, true), "Histogram of the whole latency");
  const headline = h("div.row.headline");
  const said = new Map();
  headline.say = (name, value, unit) => {
    if (!said.has(name)) {
      said.set(name, h("span"));
      headline.append(h("div", {}, h("div.faint", {}, figure(name)), h("div.big", {}, said.get(name), unit ? h("span.unit", {}, unit) : null)));
    }
    said.get(name).textContent = value;
  };
  const body = h("tbody");
  const head = ["task", "rate", "distribution, log 1 µs to 20 ms", "p50", "p99", "p99.9", "worst", "budget", "of budget", "over", "late", "held", "at tick"];
  const note = h("p.warn-text", { hidden: true }, "A recording is shown. A recording holds no timing: these figures are of the bench that runs now.");
  root.append(note, h("div.cols.latency", {},
    h("section.panel.total", {},
      h("div", {}, ownTitle, headline),
      h("div.chart", {}, big)),
    h("section.panel.tasks", {}, h("h2", {}, "Tasks ", h("small", {}, "µs since the start; line: budget. normal: p99 below the budget, nothing late, nothing held")),
      h("table.cards", {}, h("thead", {}, h("tr", {}, head.map((t, i) => h(i === 0 || i === 2 ? "th" : "th.num", {}, i === 2 ? t : figure(t))))), body))));

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
    const cells = head.slice(3).map((label) => h("td.num", { "data-label": label, ...explained(label) }));
    const picture = canvas((g, w, hgt) => histogram(g, w, hgt, counts[name], rows.get(name).budget), `Histogram of ${name}`);
    const rate = h("td.num.soft", { "data-label": "rate", ...explained("rate") });
    const line = h("tr", {}, h("td", {}, NAMES[name] || name.replaceAll("_", " ")), rate,
      h("td.picture.whole", {}, h("div.small", {}, picture)), cells);
    body.append(line);
    const use = budgetBar();
    cells[5].append(use);
    const made = { cells, use, picture, rate, budget: null };
    rows.set(name, made);
    return made;
  }

  function show(state) {
    const { timing, status } = state;
    note.hidden = !link.replay;
    own = Object.keys(timing).find((name) => name.includes(" to ")) || own;
    ownTitle.textContent = `From ${own}`;
    const total = timing[own];
    if (total?.[0]) {
      for (const [name, value] of [["p50", total[1]], ["p99", total[2]], ["worst", total[4]]]) headline.say(name, (value / 1000).toFixed(2), "ms");
      headline.say("held ticks", String(status.skipped ?? 0), "");
    }
    for (const [name, [n, p50, p99, p999, worst, tick]] of Object.entries(timing)) {
      if (name === own) continue;
      const r = row(name);
      const task = status.tasks?.[name];
      r.budget = task?.[1] ?? null;
      r.rate.textContent = task ? `${task[0]} Hz` : "";
      const texts = n ? [us(p50), us(p99), us(p999), us(worst), task ? us(task[1]) : "", null, task?.[3] ?? "", task?.[4] ?? "", task?.[5] ?? "", tick] : [];
      texts.forEach((text, i) => { if (text !== null) r.cells[i].textContent = text; });
      r.use.hidden = !(n && task);
      if (n && task) r.use.show(p99 / task[1]);
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
