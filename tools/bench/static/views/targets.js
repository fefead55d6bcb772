// The targeting experiment: bring the square onto the target. Played with the mouse, or with the motion card.
import { download, get, post } from "../api.js";
import { canvas, css, h, persistent, segments } from "../dom.js";
import { figure } from "../figures.js";

const STATUS = ["not active: press to move", "moving", "zooming"];

export function mount(root, { link, navigate }) {
  const settings = persistent("targets", { user: "", mapping: "position", source: "mouse" }, { mapping: ["position", "speed"], source: ["mouse", "card"] });
  let game = null;
  let pointer = [0, 0];
  let pressed = false;
  let shown = "";

  const screen = canvas(draw, "Targets");
  screen.style.cursor = "crosshair";
  screen.style.touchAction = "none";
  screen.id = "target-screen";
  const user = h("input", { type: "text", value: settings.user, placeholder: "Your name", maxLength: 60, oninput: () => { settings.user = user.value; settings.save(); } });
  const play = h("button.primary", { id: "target-start", onclick: start }, "New game");
  const problem = h("p.bad", { role: "alert" });
  const facts = h("table", {}, h("tr", {}, h("td.faint", {}, "None was started yet.")));
  const results = h("div");
  const reports = h("div");
  const seed = () => Math.floor(Math.random() * 1e6);

  root.append(h("div.cols.targets", {},
    h("section.panel", { style: "padding:0;overflow:hidden" }, h("div.chart", {}, screen)),
    h("div.stack.side", {},
      h("section.panel.stack", { style: "gap:8px" }, user,
        segments([["position", "angle to place"], ["speed", "angle to speed"]], settings.mapping, (v) => { settings.mapping = v; settings.save(); }, "Mapping"),
        segments([["mouse", "mouse"], ["card", "motion card"]], settings.source, (v) => { settings.source = v; settings.save(); }, "Pointer"),
        play, problem),
      h("section.panel", {}, h("h2", {}, "This game"), facts, results),
      h("section.panel", {}, h("h2", {}, "How"), h("p.note", { style: "margin:0" }, "Five squares, one after the other. Click: the view follows the mouse. Click again: it stays. Press for half a second: left and right change the size. A target counts when place and size fit within the tolerance.")),
      h("section.panel", {}, h("h2", {}, "Reports"), reports))));

  async function start() {
    problem.textContent = "";
    try {
      await post("/api/targets/start", { user: settings.user || "user", mapping: settings.mapping, source: settings.source, seed: window.micron.seed ?? seed() });
      screen.focus();
    } catch (error) { problem.textContent = error.message; }
  }

  /** The mouse stands for the hand: its place on the screen is psi and theta, so that the whole screen is within reach. */
  function move(event) {
    const box = screen.getBoundingClientRect();
    const reach = 90;
    pointer = [((event.clientX - box.left) / box.width - 0.5) * reach, ((event.clientY - box.top) / box.height - 0.5) * reach * (box.height / box.width)];
  }
  screen.addEventListener("pointermove", move);
  screen.addEventListener("pointerdown", (event) => { move(event); pressed = true; send(); screen.setPointerCapture(event.pointerId); });
  screen.addEventListener("pointerup", (event) => { move(event); pressed = false; send(); });

  const send = () => { if (game && !game.done && game.source === "mouse" && link.mayOrder) link.send({ type: "pointer", psi: pointer[0], theta: pointer[1], pressed }); };

  function draw(g, w, hgt) {
    const [sw, sh] = game?.screen || [640, 480];
    const scale = Math.min(w / sw, hgt / sh) * 0.97;
    const [ox, oy] = [(w - sw * scale) / 2, (hgt - sh * scale) / 2];
    g.fillStyle = css("--bg");
    g.fillRect(ox, oy, sw * scale, sh * scale);
    g.strokeStyle = css("--line");
    g.strokeRect(ox, oy, sw * scale, sh * scale);
    const square = (view, colour, fill, dash) => {
      const size = view.size * scale;
      const [x, y] = [ox + (view.x - view.size / 2) * scale, oy + (view.y - view.size / 2) * scale];
      g.setLineDash(dash);
      g.strokeStyle = colour;
      g.lineWidth = 2.5;
      if (fill) { g.globalAlpha = 0.16; g.fillStyle = colour; g.fillRect(x, y, size, size); g.globalAlpha = 1; }
      g.strokeRect(x, y, size, size);
      g.setLineDash([]);
      g.beginPath();
      g.moveTo(x + size / 2 - 7, y + size / 2); g.lineTo(x + size / 2 + 7, y + size / 2);
      g.moveTo(x + size / 2, y + size / 2 - 7); g.lineTo(x + size / 2, y + size / 2 + 7);
      g.stroke();
    };
    g.textAlign = "center";
    if (!game) {
      g.fillStyle = css("--soft");
      g.font = `15px ${css("--sans")}`;
      g.fillText("Start a new game", w / 2, hgt / 2);
    } else {
      if (game.target) square(game.target, css("--c2"), true, []);
      square(game.view, game.status ? css("--accent") : css("--soft"), false, game.status ? [] : [7, 5]);
      if (game.done) {
        g.fillStyle = css("--text");
        g.font = `600 26px ${css("--sans")}`;
        g.fillText(`Done in ${game.elapsed_s.toFixed(1)} s`, w / 2, hgt / 2);
      }
    }
    g.textAlign = "start";
  }

  function show(now) {
    const was = game;
    game = now;
    if (!game) return;
    const rows = [["targets", `${game.reached} of ${game.of}`], ["time", `${game.elapsed_s.toFixed(1)} s`], ["clicks", game.clicks], ["", STATUS[game.status]]];
    if (game.target) rows.splice(3, 0, ["off by", `${game.off_px.map((v) => v.toFixed(0)).join(", ")} px (±${game.tolerance_px})`]);
    const names = rows.map(([n]) => n).join();
    if (shown !== names) facts.replaceChildren(...rows.map(([n]) => h("tr", {}, h("td.soft", {}, n ? figure(n) : n), h("td.num"))));
    shown = names; // rows stay while their names do: what is pointed at keeps its explanation
    rows.forEach(([, v], i) => { facts.rows[i].cells[1].textContent = v; });
    if (game.result) {
      results.replaceChildren(h("table", {}, h("tr", {}, h("th", {}, "#"), h("th.num", {}, "time"), h("th.num", {}, figure("clicks")), h("th.num", {}, figure("turns"))),
        game.result.rows.map((r) => h("tr", {}, h("td", {}, r.target), h("td.num", {}, `${r.elapsed_s.toFixed(1)} s`), h("td.num", {}, r.clicks), h("td.num", {}, r.activations)))));
      if (!was?.result) listReports();
    } else results.replaceChildren();
  }

  async function listReports() {
    const { reports: names } = await get("/api/targets");
    reports.replaceChildren(...names.slice(0, 8).map((n) => h("div", {}, h("button.quiet", { style: "padding:2px 4px", onclick: () => download(`/api/targets/reports/${encodeURIComponent(n)}`, n) }, n))));
    if (!names.length) reports.replaceChildren(h("span.faint", {}, "One file per game, when it is done."));
  }

  const off = link.on("game", show);
  link.send({ type: "game", on: true });
  const offConnection = link.on("run", () => link.send({ type: "game", on: true }));
  let frame = 0;
  const tick = () => { frame = requestAnimationFrame(tick); send(); screen.redraw(); };
  tick();
  listReports().catch(() => {});
  const offServer = link.on("server", () => listReports().catch(() => {}));
  window.micron.game = () => game;
  return () => { cancelAnimationFrame(frame); off(); offConnection(); offServer(); link.send({ type: "game", on: false }); };
}
