// The pose wizard: an arrow from where gravity points now to the nearest pose that is missing; a pose is taken when
// the instrument has been steady in it for a second.
import { post } from "../api.js";
import { canvas, css, digits, h } from "../dom.js";
import { figure } from "../figures.js";

const VOLTS = [...[0, 1, 2, 3, 4, 5, 6, 7].map((i) => `volts_${i}`), "supply"];
const FORCE = ["specific_force_x", "specific_force_y", "specific_force_z"];
const REACH = (22 * Math.PI) / 180;
const STILL_M_S2 = 0.25;
const HOLD = 1000;
const S = 1 / Math.sqrt(3);
const FACES = [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]];
const CORNERS = [1, -1].flatMap((a) => [1, -1].flatMap((b) => [1, -1].map((c) => [a * S, b * S, c * S])));
export const POSES = [...FACES, ...CORNERS];

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

export function poseWizard(link, apply, fail) {
  const subscription = link.subscribe([...FORCE, ...VOLTS], HOLD, HOLD, 2);
  const taken = new Map();
  let up = null;
  let noise = Infinity;
  let result = null;

  const picture = canvas(draw, "Directions of gravity: done, missing, now");
  const hint = h("b");
  const meter = h("i", { style: "width:0" });
  const count = h("span.soft.num");
  const outcome = h("div");
  const identify = h("button.primary", { onclick: run }, "Identify");
  const again = h("button", { onclick: () => { taken.clear(); result = null; outcome.replaceChildren(); } }, "Start over");
  const quiet = h("button", { title: "Starts the firmware again without arming the outputs: turning is not tremor", onclick: () => post("/api/firmware/start", { sense_only: !senseOnly() }).catch(fail) });
  const senseOnly = () => link.state?.status.state === "sensing only";
  const element = h("section.panel.fig.poses", {},
    h("h2", {}, "Poses by hand ", h("small", {}, "hold each until it is taken; the arrow shows the way")),
    h("div.chart", {}, picture),
    h("div.row", { style: "margin-top:6px" }, hint), h("div.meter", { style: "margin:6px 0" }, meter),
    h("div.row", {}, identify, again, quiet, count), outcome);

  function mean(c) {
    const v = subscription.buckets.lows(c);
    return v.reduce((s, x) => s + x, 0) / v.length;
  }

  function step() {
    quiet.textContent = senseOnly() ? "Arm again" : "Arm nothing while I turn";
    quiet.disabled = !link.mayOrder;
    const b = subscription.buckets;
    if (b.n < 900 || b.perBucket !== 1) return;
    const f = [0, 1, 2].map(mean);
    const size = Math.hypot(...f) || 1;
    up = f.map((v) => v / size);
    noise = Math.hypot(...[0, 1, 2].map((c) => Math.sqrt(b.lows(c).reduce((s, x) => s + (x - f[c]) ** 2, 0) / b.n)));
    const missing = POSES.map((p, i) => [i, Math.acos(Math.max(-1, Math.min(1, dot(p, up))))]).filter(([i]) => !taken.has(i)).sort((p, q) => p[1] - q[1]);
    count.textContent = `${taken.size} of ${POSES.length} poses`;
    identify.disabled = taken.size < 12 || !link.mayOrder;
    if (!missing.length) { hint.textContent = "All poses are taken. Identify."; meter.style.width = "100%"; return; }
    const [next, angle] = missing[0];
    const steady = noise < STILL_M_S2;
    if (angle < REACH && steady) {
      taken.set(next, VOLTS.map((_, i) => mean(3 + i)));
      b.clear();
      link.ask(subscription);
      hint.textContent = "Taken.";
    } else if (angle < REACH) hint.textContent = `Hold still (${digits(noise, 2)} m/s², ${STILL_M_S2} allowed)`;
    else hint.textContent = `Turn by ${((angle * 180) / Math.PI).toFixed(0)}° along the arrow`;
    meter.style.width = `${Math.max(0, Math.min(100, 100 * (1 - angle / Math.PI)))}%`;
    meter.style.background = angle < REACH ? css(steady ? "--good" : "--warn") : css("--accent");
    picture.next = POSES[next];
  }

  function project([x, y, z], w, hgt) {
    const r = Math.min(w, hgt) * 0.42;
    const [a, b] = [0.6, 0.45];
    const u = x * Math.cos(a) - y * Math.sin(a);
    const d = x * Math.sin(a) + y * Math.cos(a);
    return [w / 2 + u * r, hgt / 2 - (z * Math.cos(b) + d * Math.sin(b)) * r, d * Math.cos(b) - z * Math.sin(b)];
  }

  function draw(g, w, hgt) {
    const r = Math.min(w, hgt) * 0.42;
    g.strokeStyle = css("--line");
    g.beginPath(); g.arc(w / 2, hgt / 2, r, 0, 7); g.stroke();
    g.font = `11px ${css("--mono")}`;
    POSES.forEach((pose, i) => {
      const [x, y, depth] = project(pose, w, hgt);
      g.globalAlpha = depth > 0.15 ? 0.45 : 1;
      g.fillStyle = taken.has(i) ? css("--good") : css("--faint");
      g.beginPath(); g.arc(x, y, taken.has(i) ? 7 : 5, 0, 7); g.fill();
      g.globalAlpha = 1; // the names are read on the far side as well
      if (i < 6) {
        g.fillStyle = css("--faint");
        g.fillText(`${"+-"[i % 2]}${"xyz"[i >> 1]}`, x + 9, y + 4);
      }
    });
    g.globalAlpha = 1;
    if (!up) return;
    const from = project(up, w, hgt);
    if (picture.next && taken.size < POSES.length) {
      // along the great circle
      const angle = Math.acos(Math.max(-1, Math.min(1, dot(up, picture.next))));
      g.strokeStyle = css("--accent");
      g.lineWidth = 2.5;
      g.beginPath();
      let last = from;
      for (let i = 0; i <= 24; i++) {
        const s = i / 24;
        const p = angle < 0.01 ? up : up.map((v, k) => (Math.sin((1 - s) * angle) * v + Math.sin(s * angle) * picture.next[k]) / Math.sin(angle));
        const at = project(p, w, hgt);
        i ? g.lineTo(at[0], at[1]) : g.moveTo(at[0], at[1]);
        if (i < 24) last = at;
      }
      g.stroke();
      const to = project(picture.next, w, hgt);
      const way = Math.atan2(to[1] - last[1], to[0] - last[0]);
      g.fillStyle = css("--accent");
      g.beginPath();
      for (const turn of [0, 2.6, -2.6]) g.lineTo(to[0] + 11 * Math.cos(way + turn), to[1] + 11 * Math.sin(way + turn));
      g.fill();
    }
    g.fillStyle = css("--text");
    g.beginPath(); g.arc(from[0], from[1], 6, 0, 7); g.fill();
    g.fillText("now", from[0] + 10, from[1] - 8);
  }

  async function run() {
    try {
      result = await post("/api/calibrate/poses", { means_V: [...taken.values()] });
      const names = ["1x", "1z", "2y", "2z", "3x", "3y"];
      outcome.replaceChildren(h("table", {}, h("tr", {}, h("th", {}, "axis"), h("th.num", {}, figure("bias")), h("th.num", {}, figure("scale"))),
        names.map((n, i) => h("tr", {}, h("td", {}, n), h("td.num", {}, `${result.table.bias_V[i].toFixed(4)} V`), h("td.num", {}, `${result.table.scale_V_per_g[i].toFixed(4)} V/g`)))),
      h("div.row", {}, h("span.soft", {}, figure("left over"), `: ${result.residual_m_s2.map((v) => digits(1000 * v, 2)).join(", ")} mm/s²`), h("button.primary", { onclick: () => apply("poses") }, "Apply to this bench")));
    } catch (error) { fail(error); }
  }

  let frame = 0;
  const tick = () => { frame = requestAnimationFrame(tick); picture.redraw(); };
  const timer = setInterval(step, 100);
  tick();
  return { element, destroy: () => { cancelAnimationFrame(frame); clearInterval(timer); link.drop(subscription); } };
}
