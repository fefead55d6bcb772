// The frame of the page: views, vital signs, alerts, the safe button.
import { get, post, setToken } from "./api.js";
import { bytes, duration, h } from "./dom.js";
import { figure, showHints } from "./figures.js";
import { layoutPanel } from "./layouts.js";
import { Link } from "./link.js";
import { replayBar } from "./replay.js";

/** Key, title, picture, and the channels without which a view shows nothing: an instrument has the views that it has channels for. */
const ALL_VIEWS = [
  ["scope", "Scope", "M3 5v14h18M6 14c2 0 2-6 4-6s2 9 4 9 2-5 4-5"],
  ["attitude", "Attitude", "M12 3l8 4.5v9L12 21l-8-4.5v-9zM12 12l8-4.5M12 12v9M12 12L4 7.5", "quaternion"],
  ["tremor", "Tremor", "M2 12h3l2-7 4 14 3-11 2 4h6", "tremor"],
  ["latency", "Latency", "M12 8v5l3 2M12 3a9 9 0 1 0 0 18 9 9 0 0 0 0-18z"],
  ["actuators", "Actuators", "M6 3v18M12 3v18M18 3v18M4 14h4M10 8h4M16 16h4", "command"],
  ["targets", "Targets", "M12 3a9 9 0 1 0 0 18 9 9 0 0 0 0-18zM12 8a4 4 0 1 0 0 8 4 4 0 0 0 0-8zM12 1v4M12 19v4M1 12h4M19 12h4"],
  ["collect", "Collect", "M12 3v12m-4-4l4 4 4-4M4 17v3h16v-3"],
  ["mismatch", "Mismatch", "M3 17c3 0 4-10 9-10s5 6 9 6M3 20c4 0 5-7 9-7s6 3 9 3"],
  ["calibrate", "Calibrate", "M4 20l5-5m0 0l9-9 2 2-9 9zM13 7l4 4", "volts"],
  ["setup", "Setup", "M5 4v6a3 3 0 0 0 3 3h8a3 3 0 0 1 3 3v4M3 4h4M17 20h4M12 13v7M10 20h4"],
];

const hash = new URLSearchParams(location.hash.slice(1));
if (hash.has("token")) {
  localStorage.setItem("micron.token", hash.get("token"));
  history.replaceState(null, "", `#/${localStorage.getItem("micron.view") || "scope"}`);
}
const token = localStorage.getItem("micron.token") || "";
setToken(token);

const byId = (id) => document.getElementById(id);
const link = new Link(token);
let VIEWS = [];
const context = { link, catalogue: [], navigate: (name) => { location.hash = `/${name}`; }, view: () => shown, reload, say };
let unmount = null;
let shown = "";
let shows = 0;

/** One message at the top of the page; it goes when it is pressed. */
function say(text) {
  const box = byId("say");
  box.hidden = !text;
  box.replaceChildren(text, h("button", { onclick: () => say("") }, "Close"));
}

/** Mount a view again: its settings are others. */
function reload(name) {
  shown = "";
  if (location.hash.slice(2) === name) show(name);
  else context.navigate(name);
}

async function show(name) {
  if (!VIEWS.some(([key]) => key === name)) name = "scope";
  if (name === shown) return;
  shown = name;
  const turn = ++shows; // a view that is asked for again while it is loaded is mounted once
  unmount?.();
  unmount = null;
  const root = byId("view");
  root.replaceChildren();
  byId("nav").querySelectorAll("a").forEach((a) => (a.dataset.view === name ? a.setAttribute("aria-current", "page") : a.removeAttribute("aria-current")));
  const view = await import(`./views/${name}.js`);
  if (turn !== shows) return;
  document.title = `${VIEWS.find(([key]) => key === name)[1]} · Micron bench`;
  unmount = view.mount(root, context) || null;
  root.dataset.view = name;
  localStorage.setItem("micron.view", name);
}

function buildNav() {
  const layouts = layoutPanel(link, context);
  byId("view").after(layouts.element);
  VIEWS.forEach(([key, title, path], i) => {
    const a = h("a", { href: `#/${key}`, onclick: () => layouts.show(false) });
    a.dataset.view = key;
    a.innerHTML = `<svg viewBox="0 0 24 24" aria-hidden="true"><path d="${path}"/></svg>`;
    a.append(title, h("kbd", {}, String((i + 1) % 10)));
    byId("nav").append(a);
  });
  context.bar = replayBar(link, context);
  byId("top").append(context.bar.element);
  const button = h("button", { onclick: () => layouts.toggle() });
  button.innerHTML = '<svg viewBox="0 0 24 24" aria-hidden="true"><path d="M4 4h16v16H4zM4 10h16M10 10v10"/></svg>';
  button.append("Layouts");
  byId("nav").append(button);
  const open = (on) => {
    byId("nav").classList.toggle("open", on);
    byId("menu").setAttribute("aria-expanded", String(on));
  };
  byId("menu").onclick = (event) => {
    event.stopPropagation();
    open(!byId("nav").classList.contains("open"));
  };
  document.addEventListener("click", () => open(false));
  byId("nav").addEventListener("keydown", (event) => { if (event.key === "Tab") setTimeout(() => open(byId("nav").contains(document.activeElement))); });
}

/** Two fingers may enlarge the page so far that the button in the bar is outside: a second one stays in what is seen. */
function keepSafeNear() {
  const near = byId("safe-near");
  const seen = window.visualViewport;
  if (!seen) return;
  const place = () => {
    const box = byId("safe").getBoundingClientRect();
    const [left, top, right, bottom] = [seen.offsetLeft, seen.offsetTop, seen.offsetLeft + seen.width, seen.offsetTop + seen.height];
    near.hidden = seen.scale < 1.01 || (box.left >= left && box.right <= right && box.top >= top && box.bottom <= bottom);
    if (near.hidden) return;
    near.style.transform = `scale(${1 / seen.scale})`;
    near.style.left = `${right - (near.offsetWidth + 8) / seen.scale}px`;
    near.style.top = `${top + 8 / seen.scale}px`;
  };
  seen.addEventListener("resize", place);
  seen.addEventListener("scroll", place);
  place();
}

let vitals = new Map();
function showVitals(state) {
  const s = state.status;
  const latency = Object.keys(state.timing).find((name) => name.includes(" to ")); // the instrument's own, beside its tasks
  const timing = state.timing[latency];
  const outputs = s.tasks?.actuate; // rate, budget, runs, overruns, late, skipped
  const share = outputs ? (100 * outputs[5]) / Math.max(1, outputs[2] + outputs[5]) : 0;
  const items = [ // name, value, whether it is as it should be
    ["run time", s.t_s === undefined ? "–" : duration(s.t_s), true],
    [`${latency} p50`, timing?.[0] ? `${(timing[1] / 1000).toFixed(2)} ms` : "–", true],
    ["lost scans", s.lost ?? "–", !s.lost],
    ["outputs held", outputs ? `${share === 0 ? 0 : share < 0.1 ? "<0.1" : share.toFixed(1)} %` : "–", share < 1],
    ["tremor", s.amplitude_um ? `${Math.hypot(...s.amplitude_um).toFixed(0)} µm` : "–", true],
  ].filter(([name]) => (name !== "tremor" || s.amplitude_um) && (name !== "outputs held" || outputs) && (name !== `${latency} p50` || latency));
  if (items.map(([name]) => name).join() !== [...vitals.keys()].join()) {
    vitals = new Map(items.map(([name]) => [name, h("dd")]));
    byId("vitals").replaceChildren(...items.map(([name]) => h("div", {}, h("dt", {}, figure(name)), vitals.get(name))));
  }
  for (const [name, value, good] of items) {
    const cell = vitals.get(name);
    if (cell.textContent !== String(value)) cell.textContent = value;
    cell.classList.toggle("warn-text", !good);
  }
}

const PHASES = {
  starting: ["warn", "starting"], running: ["good", "running"], safe: ["bad", "safe state"],
  ended: ["bad", "neutral not confirmed"], failed: ["bad", "failed"],
};

function showPhase() {
  const pill = byId("phase");
  const state = link.state;
  let [kind, text] = state ? PHASES[state.phase] : ["", "connecting"];
  if (state?.phase === "running") text = (state.status.manual ?? "off") !== "off" ? "manual drive" : state.status.state;
  if (state?.phase === "running" && state.status.state !== "running") kind = "warn";
  if (!link.connected) [kind, text] = ["bad", "not connected"];
  pill.className = `pill ${kind}`;
  pill.textContent = text;
}

let lastAlerts = "";
function showAlerts() {
  const alerts = [...(link.state?.alerts || [])];
  const age = (performance.now() - link.lastMessage) / 1000;
  if (!link.connected) alerts.unshift({ kind: "error", text: "Connection to the bench server lost. What you see is old. Trying again …" });
  else if (age > 1.5) alerts.unshift({ kind: "error", text: `The bench server has said nothing for ${age.toFixed(0)} s. What you see is old.` });
  showTokenForm();
  if (link.connected && link.state && !link.mayOrder) {
    const remedy = link.refused ? "" : ": to control the bench open the address that “micron bench” printed";
    alerts.push({ kind: "info", text: `View only${remedy}. The safe button of this page has no effect.` });
  }
  const text = JSON.stringify(alerts) + link.mayOrder + link.state?.phase;
  if (text === lastAlerts) return;
  lastAlerts = text;
  const ended = ["safe", "ended", "failed"].includes(link.state?.phase);
  byId("alerts").replaceChildren(
    ...alerts.map((alert, i) => h(`p.${alert.kind}`, {}, alert.text,
      i === 0 && ended && link.connected && link.mayOrder ? h("button", { onclick: () => post("/api/firmware/start").catch((error) => say(error.message)) }, "Start again") : null,
      alert.order && link.connected && link.mayOrder ? h("button", { onclick: () => link.order(alert.order) }, "Resume") : null)),
  );
}

/** The server does not know the page's token: it is asked for in words, and everything on the page stays. */
function showTokenForm() {
  const form = byId("ask-token");
  if (form.hidden === !link.refused) return;
  form.hidden = !link.refused;
  const cause = link.wasTrusted ? "The bench server was started again and has a new token." : "The bench server does not know the token of this page.";
  form.querySelector("label").textContent = `${cause} Paste the address that “micron bench” printed; what is on this page stays.`;
}

function useToken(event) {
  event.preventDefault();
  const given = byId("token").value.trim();
  const token = given.includes("#") ? new URLSearchParams(given.slice(given.indexOf("#") + 1)).get("token") : given;
  byId("token").value = "";
  if (!token) return;
  localStorage.setItem("micron.token", token);
  setToken(token);
  link.useToken(token);
}

function showRecording(state) {
  const box = byId("rec");
  box.hidden = !state.recording;
  if (state.recording) box.textContent = `REC ${duration(state.recording.seconds)}`;
}

function showLog(lines) {
  const last = lines[lines.length - 1];
  byId("last-log").textContent = last.text;
  byId("last-log").className = last.level;
  byId("log").replaceChildren(...link.log.slice().reverse().map((line) =>
    h("div", { className: line.level }, h("time", {}, new Date(line.time * 1000).toLocaleTimeString()), line.text)));
}

/** The one button that must always work: over the websocket, and by request in case that is stuck. An order that reached
 * nobody is said: the person has to act. */
function goSafe() {
  link.order("safe");
  post("/api/safe").catch((error) => say(`The safe order did not reach the bench (${error.message}). Switch the amplifier off if there is danger.`));
}

function setTheme(theme) {
  document.documentElement.dataset.theme = theme;
  localStorage.setItem("micron.theme", theme);
  window.dispatchEvent(new Event("themechange"));
}

function bindKeys() {
  document.addEventListener("keydown", (event) => {
    if (event.key === "Escape") { goSafe(); return; }
    if (event.ctrlKey || event.metaKey || event.altKey || /INPUT|SELECT|TEXTAREA/.test(event.target.tagName)) return;
    const view = /^\d$/.test(event.key) ? VIEWS[(Number(event.key) + 9) % 10] : null;
    if (view) context.navigate(view[0]);
    else if (event.key === "t" || event.key === "T") byId("theme").click();
  });
}

/** The channels of the instrument that runs, and the views that it has channels for. Another instrument is another page. */
async function loadInstrument() {
  let found = null;
  while (!found) { // behind --listen an old token is refused until the new one is given
    try { found = await get("/api/channels"); } catch { await new Promise((done) => setTimeout(done, 1000)); }
  }
  context.catalogue = found.channels;
  VIEWS = ALL_VIEWS.filter(([, , , needs]) => !needs || found.channels.some((c) => c.group === needs));
  link.on("run", ({ instrument }) => { if (instrument !== found.instrument) location.reload(); });
  let rateHz = link.rateHz;
  const follow = () => { // rows of another rate: the view asks for others
    if (link.rateHz !== rateHz && shown) { rateHz = link.rateHz; reload(shown); }
  };
  link.on("state", follow);
  link.on("source", follow);
}

async function boot() {
  setTheme(localStorage.getItem("micron.theme") || (matchMedia("(prefers-color-scheme: light)").matches ? "light" : "dark"));
  bindKeys();
  byId("theme").onclick = () => setTheme(document.documentElement.dataset.theme === "dark" ? "light" : "dark");
  byId("safe").onclick = byId("safe-near").onclick = goSafe;
  keepSafeNear();
  showHints(byId("hint"));
  byId("log-toggle").onclick = () => {
    byId("log").hidden = !byId("log").hidden;
    byId("log-toggle").setAttribute("aria-expanded", String(!byId("log").hidden));
  };
  link.on("state", (state) => {
    byId("bench-name").textContent = `${state.bench}${state.emulated ? " · emulated" : ""}${state.compiled ? " · compiled" : ""}`;
    byId("foot").title = `${bytes(state.disk.free)} free for recordings`;
    showVitals(state);
    showRecording(state);
    showPhase();
    showAlerts();
  });
  link.on("log", showLog);
  link.on("connection", () => { showPhase(); showAlerts(); });
  setInterval(() => { showPhase(); showAlerts(); }, 500);
  byId("ask-token").onsubmit = useToken;
  await loadInstrument();
  buildNav();
  window.addEventListener("hashchange", () => show(location.hash.slice(2)));
  await show(location.hash.slice(2));
}

window.micron = { link, context };
boot();
