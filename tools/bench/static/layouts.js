// Layouts: what the views show, under a name, on the server beside the bench file or as a file of one's own.
import { get, post } from "./api.js";
import { h } from "./dom.js";

const KEYS = ["scope.2", "tremor", "attitude", "actuators"]; // settings of views; who one is and what one may do stays
const KIND = "micron bench layout";
const FORMAT = 1;

const stored = (key) => JSON.parse(localStorage.getItem(key) || "null");

/** The settings of all views as they are now. Keys in a fixed order, so that equal layouts are equal texts. */
export function capture(view) {
  const settings = {};
  for (const key of KEYS) {
    const value = stored(`micron.${key}`);
    if (value) settings[key] = value;
  }
  return { kind: KIND, format: FORMAT, view, settings };
}

/** Put a layout into the page's settings. What a view does not know it leaves out when it is drawn. */
export function apply(layout) {
  const isObject = (v) => v !== null && typeof v === "object" && !Array.isArray(v);
  if (!isObject(layout) || layout.kind !== KIND) throw new Error("This file is not a layout of the bench page.");
  if (layout.format !== FORMAT) throw new Error(`This layout has format ${layout.format}; this page reads format ${FORMAT}.`);
  if (!isObject(layout.settings) || !Object.values(layout.settings).every(isObject)) throw new Error("This layout has no settings.");
  for (const key of KEYS) {
    if (layout.settings[key]) localStorage.setItem(`micron.${key}`, JSON.stringify(layout.settings[key]));
    else localStorage.removeItem(`micron.${key}`);
  }
}

export function layoutPanel(link, context) {
  const problem = h("p.bad", { role: "alert" });
  const now = h("p.soft");
  const list = h("div.stack.list");
  const folder = h("p.note");
  const name = h("input", { type: "text", maxLength: 80, placeholder: "Name of the layout", "aria-label": "Name of the layout", onkeydown: (e) => { if (e.key === "Enter") save(); } });
  const saveButton = h("button.primary", { onclick: save }, "Save");
  const file = h("input", { type: "file", accept: ".json", hidden: true, "aria-label": "Layout file", onchange: fromFile });
  const close = h("button.quiet", { "aria-label": "Close layouts", onclick: () => show(false) }, "Close");
  const element = h("section.panel", { id: "layouts", hidden: true, "aria-label": "Layouts" },
    h("h2", {}, "Layouts ", h("small", {}, "what the views show"), h("span.grow"), close), now, list,
    h("div.row", {}, name, saveButton, h("button", { onclick: toFile }, "To a file"), h("button", { onclick: () => file.click() }, "From a file"), file), problem, folder);

  const fail = (error) => { problem.textContent = error.message; };
  const last = () => stored("micron.layout");
  const remember = (title, layout) => localStorage.setItem("micron.layout", JSON.stringify({ name: title, was: JSON.stringify(layout) }));

  function sayNow() {
    const used = last();
    if (!used) { now.textContent = "No layout is in use. Save what you see under a name."; return; }
    const changed = JSON.stringify(capture(JSON.parse(used.was).view)) !== used.was;
    now.textContent = `In use: ${used.name}${changed ? ", changed since" : ""}.`;
  }

  async function refresh() {
    sayNow();
    saveButton.disabled = !link.mayOrder;
    let found;
    try { found = await get("/api/layouts"); } catch (error) { fail(error); return; }
    folder.textContent = `Saved in ${found.folder}, with the bench.`;
    list.replaceChildren(...found.layouts.map((title) => {
      let sure = false;
      const remove = h("button.quiet", { disabled: !link.mayOrder, "aria-label": `Delete the layout ${title}`, onclick: async () => {
        if (!sure) { sure = true; remove.textContent = "Really delete?"; remove.classList.add("bad"); return; }
        try { await post(`/api/layouts/${encodeURIComponent(title)}/delete`); } catch (error) { fail(error); }
        refresh();
      } }, "Delete");
      return h("div.row", {}, h("button.use", { onclick: () => load(title) }, title), h("span.grow"), remove);
    }));
    if (!found.layouts.length) list.replaceChildren(h("span.soft", {}, "None is saved yet."));
  }

  function use(title, layout) {
    apply(layout);
    context.reload(layout.view);
    remember(title, capture(layout.view));
    name.value = title;
    sayNow();
  }

  async function load(title) {
    problem.textContent = "";
    try { use(title, await get(`/api/layouts/${encodeURIComponent(title)}`)); } catch (error) { fail(error); }
  }

  async function save() {
    problem.textContent = "";
    const layout = capture(context.view());
    try { remember((await post("/api/layouts", { name: name.value, layout })).name, layout); } catch (error) { fail(error); }
    refresh();
  }

  function toFile() {
    const title = name.value.trim() || last()?.name || "layout";
    const link_ = h("a", { href: URL.createObjectURL(new Blob([JSON.stringify(capture(context.view()), null, 1)], { type: "application/json" })), download: `${title}.layout.json` });
    link_.click();
    setTimeout(() => URL.revokeObjectURL(link_.href), 60000);
  }

  async function fromFile() {
    problem.textContent = "";
    const [chosen] = file.files;
    file.value = "";
    if (!chosen) return;
    try {
      if (chosen.size > 65536) throw new Error(`${chosen.name} is not a layout: it has more than 64 kB.`);
      let layout;
      try { layout = JSON.parse(await chosen.text()); } catch { throw new Error(`${chosen.name} is not a layout: it is not JSON.`); }
      use(chosen.name.replace(/(\.layout)?\.json$/, ""), layout);
    } catch (error) { fail(error); }
  }

  function show(on) {
    element.hidden = !on;
    problem.textContent = "";
    if (!on) return;
    name.value = last()?.name || "";
    refresh();
    name.focus();
  }

  link.on("server", () => { if (!element.hidden) refresh(); });
  return { element, show, toggle: () => show(element.hidden) };
}
