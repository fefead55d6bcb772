// The three stacks: volts, strokes, hysteresis; and driving them by hand while a button is held.
import { canvas, colours, css, digits, h, persistent, segments } from "../dom.js";
import { explained, figure } from "../figures.js";
import { holdSpans } from "../holds.js";
import { Strip, interleave, times } from "../plot.js";

const CHANNELS = ["command_1", "command_2", "command_3", "stroke_1", "stroke_2", "stroke_3", "clip"];
const REPEAT_MS = 50;
const CLIP = [[1, "workspace"], [2, "voltage"], [4, "slew"]];

export function mount(root, { link }) {
  const settings = persistent("actuators", { rate: 20 }, { rate: [2, 20, 100] });
  const subscription = link.subscribe(CHANNELS, 8000, 2000);
  let armTimer = 0;
  let jogTimer = 0;

  const cards = [0, 1, 2].map((c) => {
    const volts = h("div.big", { tabIndex: 0, ...explained("command") });
    const stroke = h("div.num.soft.what", { tabIndex: 0, ...explained("stroke") });
    const fill = h("i");
    const loop = canvas((g, w, hgt) => drawLoop(g, w, hgt, c), `Hysteresis loop of stack ${c + 1}`);
    const minus = holdButton("−", c, -1);
    const plus = holdButton("+", c, 1);
    const element = h("section.panel.fig", {},
      h("h2", {}, h("span", { style: `color:var(--c${c + 1})` }, "●"), `Stack ${c + 1}`),
      h("div.row", { style: "justify-content:space-between;align-items:baseline" }, volts, stroke),
      h("div.meter", { style: "margin:6px 0;position:relative" }, fill, h("span", { style: "position:absolute;left:50%;top:0;bottom:0;width:1px;background:var(--soft)" })),
      h("div.row.faint.ends", {}, h("span", {}, "0 V"), h("span", {}, "neutral"), h("span", {}, "100 V")),
      h("div.chart", {}, loop),
      h("div.row", { style: "margin-top:8px" }, minus, plus));
    return { volts, stroke, fill, loop, element, buttons: [minus, plus] };
  });

  function holdButton(text, channel, sign) {
    const start = (event) => {
      event.preventDefault();
      if (jogTimer) return;
      const send = () => link.order("jog", { channel, rate_V_per_s: sign * settings.rate });
      send();
      jogTimer = setInterval(send, REPEAT_MS);
      button.setAttribute("aria-pressed", "true");
    };
    const stop = () => {
      clearInterval(jogTimer);
      jogTimer = 0;
      button.setAttribute("aria-pressed", "false");
    };
    const button = h("button.jog", {
      disabled: true, "aria-label": `Hold: stack ${channel + 1} ${sign > 0 ? "up" : "down"}`,
      onpointerdown: start, onpointerup: stop, onpointerleave: stop, onpointercancel: stop, onblur: stop,
      onkeydown: (event) => { if ((event.key === " " || event.key === "Enter") && !event.repeat) start(event); },
      onkeyup: (event) => { if (event.key === " " || event.key === "Enter") stop(); },
    }, text);
    button.stop = stop;
    return button;
  }

  const arm = h("button", { id: "arm", role: "switch", "aria-checked": "false", onclick: toggle, style: "min-width:150px" }, "Arm manual drive");
  const manual = h("span.soft");
  function toggle() {
    if (armTimer) disarm();
    else {
      link.order("arm");
      armTimer = setInterval(() => link.order("arm"), 300);
    }
    showArm();
  }
  function disarm() {
    clearInterval(armTimer);
    armTimer = 0;
    cards.forEach((card) => card.buttons.forEach((b) => b.stop()));
    link.order("disarm");
  }
  function showArm() {
    const state = link.state?.status?.manual || "off";
    const running = link.state?.phase === "running" && link.state.status.state === "running" && !link.replay; // nobody drives by what was recorded
    if (armTimer && !running) disarm();
    const armed = Boolean(armTimer);
    arm.setAttribute("aria-checked", String(armed));
    arm.textContent = armed ? "Armed: disarm" : "Arm manual drive";
    arm.disabled = !link.mayOrder || !running;
    cards.forEach((card) => card.buttons.forEach((b) => { b.disabled = !armed || state !== "armed"; }));
    manual.textContent = state === "armed" ? "Compensation is off. Hold a button to move; release stops." : state === "returning" ? "Going back to neutral …"
      : link.replay ? "A recording is shown: go back to live to drive by hand."
        : link.mayOrder ? "Compensation drives the stacks. Arm to move them by hand." : "View only.";
  }

  const strip = new Strip([1, 2, 3].map((n) => ({ label: `command ${n}`, unit: "V" })), { least: 10, xTitle: "time, s", yTitle: "V" });
  const clips = CLIP.map(([, name]) => figure(name, ""));
  const limited = h("span.soft.what", { tabIndex: 0, ...explained("limited") });
  const limits = h("div.row.num", { style: "font-size:12px;gap:16px" }, clips, limited);
  root.append(h("div.cols.actuators", {},
    h("section.panel.row", {}, arm, h("span.soft", {}, "speed"),
      segments([[2, "2"], [20, "20"], [100, "100 V/s"]], settings.rate, (v) => { settings.rate = Number(v); settings.save(); }, "Jog speed"), manual, h("span.grow"), limits),
    h("div.cols.stacks", {}, cards.map((c) => c.element)),
    h("div.strips", {}, strip.element)));

  function drawLoop(g, w, hgt, c) {
    const b = subscription.buckets;
    if (!b.n) return;
    const [volts, um] = [b.lows(c), b.lows(3 + c)];
    let [low, high] = [-2e-6, 2e-6];
    for (const v of um) { low = Math.min(low, v); high = Math.max(high, v); }
    const [left, bottom] = [34, 16];
    const x = (v) => left + ((w - left - 4) * v) / 100;
    const y = (v) => hgt - bottom - ((hgt - bottom - 14) * (v - low)) / (high - low);
    g.font = `10px ${css("--mono")}`;
    g.strokeStyle = css("--grid");
    g.fillStyle = css("--faint");
    for (const v of [0, 25, 50, 75, 100]) {
      g.beginPath(); g.moveTo(x(v), 4); g.lineTo(x(v), hgt - bottom); g.stroke();
      g.fillText(v === 100 ? "V" : v, x(v) - (v === 100 ? 8 : 5), hgt - 4);
    }
    for (const v of [low, 0, high]) {
      g.beginPath(); g.moveTo(left, y(v)); g.lineTo(w, y(v)); g.stroke();
      g.fillText(v === high ? `${digits(v * 1e6, 2)} µm` : digits(v * 1e6, 2), 2, y(v) + (v === high ? -3 : 3)); // above its line: the unit needs room
    }
    g.strokeStyle = colours()[c];
    g.lineWidth = 1.3;
    g.beginPath();
    for (let i = 0; i < volts.length; i++) g.lineTo(x(volts[i]), y(um[i]));
    g.stroke();
    const last = volts.length - 1;
    g.fillStyle = css("--text");
    g.beginPath(); g.arc(x(volts[last]), y(um[last]), 3, 0, 7); g.fill();
  }

  let frame = 0;
  let turn = 0;
  function draw() {
    frame = requestAnimationFrame(draw);
    if (++turn % 2) return; // 30 pictures a second are enough here
    const b = subscription.buckets;
    if (!b.n) return;
    cards.forEach((card, c) => {
      const v = b.last(c);
      card.volts.replaceChildren(v.toFixed(1), h("span.unit", {}, "V"));
      card.stroke.textContent = `${(b.last(3 + c) * 1e6).toFixed(2)} µm`;
      card.fill.style.width = `${v}%`;
      card.fill.style.background = v < 1 || v > 99 ? css("--warn") : colours()[c];
      card.loop.redraw();
    });
    const t = b.times();
    strip.show(times(b, t[t.length - 1]), [0, 1, 2].map((c) => interleave(b, c)), -8, 0, null, holdSpans(link.holds, t[t.length - 1], -8, 0));
    let bits = 0;
    for (const v of b.highs(6)) bits |= v;
    const s = link.state?.status || {};
    CLIP.forEach(([bit, name], i) => {
      clips[i].className = `what ${bits & bit ? "warn-text" : "faint"}`;
      clips[i].textContent = `${name} ${bits & bit ? "limited" : "ok"}`;
    });
    limited.textContent = `${s.clipped ?? 0} of ${s.commands ?? 0} commands limited`;
  }
  const off = link.on("state", showArm);
  const retheme = () => strip.build();
  window.addEventListener("themechange", retheme);
  window.addEventListener("blur", disarmIfArmed);
  function disarmIfArmed() { if (armTimer) { disarm(); showArm(); } }
  showArm();
  draw();
  return () => {
    cancelAnimationFrame(frame);
    disarmIfArmed();
    off();
    window.removeEventListener("themechange", retheme);
    window.removeEventListener("blur", disarmIfArmed);
    link.drop(subscription);
    strip.destroy();
  };
}
