// Small helpers around the DOM.

/** An element: h("button.primary", {onclick, title}, "text", child). A dot in the tag adds classes. */
export function h(tag, props = {}, ...children) {
  const [name, ...classes] = tag.split(".");
  const element = document.createElement(name || "div");
  if (classes.length) element.className = classes.join(" ");
  for (const [key, value] of Object.entries(props)) {
    if (value === undefined || value === null) continue;
    if (key.startsWith("on")) element.addEventListener(key.slice(2), value);
    else if (key === "style" || key.includes("-") || key === "role" || key === "for") element.setAttribute(key, value);
    else element[key] = value;
  }
  element.append(...children.flat().filter((child) => child !== null && child !== undefined));
  return element;
}

export const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

/** Colours of series, read from the theme. */
export const colours = () => [1, 2, 3, 4, 5, 6, 7, 8].map((i) => css(`--c${i}`));

/** A number with a sensible number of digits, as wide as its neighbours. */
export function digits(value, n = 4) {
  if (value === undefined || value === null || !Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  if (size !== 0 && (size >= 1e6 || size < 1e-4)) return value.toExponential(2);
  const places = Math.max(0, Math.min(6, n - 1 - Math.floor(Math.log10(size || 1))));
  return value.toFixed(size === 0 ? n - 1 : places);
}

/** A unit as people write it. */
export const unitText = (unit) => (unit === "1" || unit === "bits" ? "" : unit.replace("^2", "²").replace("uT", "µT").replace("degC", "°C"));

export const bytes = (n) => (n > 1e9 ? `${(n / 1e9).toFixed(1)} GB` : n > 1e6 ? `${(n / 1e6).toFixed(1)} MB` : `${Math.ceil(n / 1e3)} kB`);

export function duration(s) {
  const whole = Math.max(0, Math.round(s));
  const parts = [Math.floor(whole / 60) % 60, whole % 60].map((v) => String(v).padStart(2, "0"));
  return whole >= 3600 ? `${Math.floor(whole / 3600)}:${parts.join(":")}` : parts.join(":");
}

/** A row of buttons of which one is chosen. */
export function segments(options, value, onchange, label) {
  const box = h("div.seg", { role: "group", "aria-label": label });
  const show = (now) => box.querySelectorAll("button").forEach((b) => b.setAttribute("aria-pressed", b.dataset.value === String(now)));
  for (const [key, text] of options) {
    const button = h("button", { type: "button", onclick: () => { show(key); onchange(key); } }, text);
    button.dataset.value = key;
    box.append(button);
  }
  show(value);
  box.show = show;
  return box;
}

/** The formats that the server exports to, with what reads them. */
export const exportOptions = (formats) => formats.map(([ending, readers]) => h("option", { value: ending }, `${ending}: ${readers}`));

/** A canvas that follows its box; `draw(context, width, height)` in CSS pixels. */
export function canvas(draw, label) {
  const element = h("canvas.draw", { role: "img", "aria-label": label });
  element.redraw = () => {
    const { clientWidth: w, clientHeight: hgt } = element;
    if (!w || !hgt) return;
    const ratio = window.devicePixelRatio || 1;
    if (element.width !== Math.round(w * ratio) || element.height !== Math.round(hgt * ratio)) {
      element.width = Math.round(w * ratio);
      element.height = Math.round(hgt * ratio);
    }
    const context = element.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, w, hgt);
    draw(context, w, hgt);
  };
  new ResizeObserver(() => element.redraw()).observe(element); // else it is stretched until the next time
  return element;
}

/** Settings of a view that outlive the page. `allowed`: the values that a setting may have, where they are few. */
export function persistent(key, defaults, allowed = {}) {
  let saved = {};
  try { saved = JSON.parse(localStorage.getItem(`micron.${key}`) || "{}"); } catch { saved = {}; }
  const values = { ...structuredClone(defaults) };
  for (const [name, value] of Object.entries(saved || {})) {
    const fits = allowed[name] ? allowed[name].includes(value) : typeof value === typeof defaults[name] && Array.isArray(value) === Array.isArray(defaults[name]);
    if (name in defaults && fits) values[name] = value;
  }
  values.save = () => localStorage.setItem(`micron.${key}`, JSON.stringify({ ...values, save: undefined }));
  return values;
}
