// Holds of the firmware as spans of a time axis.
import { digits } from "./dom.js";

/** Holds between x0 and x1 of an axis whose zero is bench time `origin`, s: [{x0, x1, text}]. */
export function holdSpans(holds, origin, x0, x1) {
  return (holds || []).map(({ from_s, to_s, cause }) => ({
    x0: from_s - origin, x1: to_s === null ? x1 : to_s - origin,
    text: `hold${to_s === null ? "" : ` ${digits(to_s - from_s, 2)} s`}: ${cause || "cause not told"}`,
  })).filter((span) => span.x1 > x0 && span.x0 < x1);
}

/** What is said of the spans that are seen: the newest, and how many there are. */
export const spanText = (spans) => (spans.length ? `${spans[spans.length - 1].text}${spans.length > 1 ? ` (and ${spans.length - 1} more)` : ""}` : "");

/** Draw spans behind traces: `left`, `right`, `top`, `bottom` of the frame, `at(x)` the place of a value, all in pixels of `g`. */
export function drawSpans(g, spans, { left, right, top, bottom }, at, colour, ratio = 1) {
  g.save();
  for (const { x0, x1, text } of spans) {
    const [a, b] = [Math.max(left, at(x0)), Math.min(right, at(x1))];
    if (b <= a) continue;
    const wide = Math.max(b - a, 2 * ratio);
    g.globalAlpha = 0.22;
    g.fillStyle = colour;
    g.fillRect(a, top, wide, bottom - top);
    g.globalAlpha = 1;
    g.fillRect(a, top, wide, 3 * ratio);
    if (wide < 60 * ratio) continue; // no room for words; they are beside the axis
    g.save();
    g.beginPath();
    g.rect(a, top, wide, bottom - top);
    g.clip();
    g.font = `600 ${10 * ratio}px sans-serif`;
    g.fillText(text, a + 4 * ratio, bottom - 5 * ratio);
    g.restore();
  }
  g.restore();
}
