// The twin that watches: residual of each channel against the reference, where reality leaves it, the last minute.
import { canvas, colours, css, digits, h, unitText } from "../dom.js";

const KEPT = 600; // status messages: a minute

/** A panel that shows itself while a twin watches. `diagnose` is called by its button. */
export function watchPanel(link, diagnose) {
  let past = []; // [t_s, rms over reference by channel]
  let run = -1;
  const said = h("span.soft");
  const place = h("div.bad", { role: "status" });
  const rows = h("tbody");
  const chart = canvas(draw, "Residual of each channel, in reference rms, over the last minute");
  const button = h("button", { onclick: diagnose, title: "The engine looks at the last minute of the twin's channels, in a process of its own" }, "Diagnose the last minute");
  const titles = ["residual, rms", "reference", "ratio", "alarms", "since"];
  const element = h("section.panel.watch", { hidden: true },
    h("div.row", {}, h("h2", {}, "Twin that watches"), said, h("span.grow"), button),
    place,
    h("div.chart", { style: "height:120px" }, chart),
    h("table.cards", {}, h("thead", {}, h("tr", {}, h("th", {}, "channel"), titles.map((t) => h("th.num", {}, t)))), rows));

  function show(state) {
    const w = state.watch;
    element.hidden = !w;
    if (!w) return;
    if (state.run !== run) { run = state.run; past = []; }
    const names = Object.keys(w.reference_rms || {});
    said.textContent = w.phase === "failed" ? "" : w.phase === "reference" ? `reference: ${digits(w.t_s, 3)} of ${w.reference_s} s` : `at most ${w.false_alarms_per_hour} false alarms per hour, ${(100 * w.cpu_share).toFixed(1)} % of a processor`;
    const first = w.alarms?.[0];
    place.textContent = w.phase === "failed" ? w.why : first ? `Reality leaves the twin: ${first.channel}, since about ${first.onset_s.toFixed(1)} s of the run.` : "";
    button.disabled = !link.mayOrder || w.phase === "failed";
    if (w.phase === "watching") {
      past.push([w.t_s, names.map((n) => w.rms[n] / w.reference_rms[n])]);
      past = past.slice(-KEPT);
    }
    rows.replaceChildren(...names.map((name, i) => {
      const alarm = w.alarms.find((a) => a.channel === name);
      const unit = unitText(w.unit[name]);
      const cells = [`${digits(w.rms[name], 3)} ${unit}`, `${digits(w.reference_rms[name], 3)} ${unit}`, digits(w.rms[name] / w.reference_rms[name], 3), w.counts[name] || 0, alarm ? `${alarm.onset_s.toFixed(1)} s` : "–"];
      return h(alarm ? "tr.bad" : "tr", {}, h("td.whole", { style: `color:${colours()[i % 8]}` }, name), cells.map((v, k) => h("td.num", { "data-label": titles[k] }, String(v))));
    }));
    chart.redraw();
  }

  function draw(c, width, height) {
    if (past.length < 2) return;
    const most = Math.max(2, ...past.flatMap(([, r]) => r.filter(Number.isFinite)));
    const y = (v) => height - 4 - (v / most) * (height - 8);
    c.strokeStyle = css("--line");
    c.beginPath();
    c.moveTo(0, y(1));
    c.lineTo(width, y(1));
    c.stroke();
    colours().slice(0, past.at(-1)[1].length).forEach((colour, i) => {
      c.strokeStyle = colour;
      c.beginPath();
      past.forEach(([, r], k) => c.lineTo((k / (KEPT - 1)) * width, y(r[i])));
      c.stroke();
    });
  }

  const off = link.on("state", show);
  if (link.state) show(link.state);
  return { element, stop: off };
}
