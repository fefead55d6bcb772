// The instrument as a small solid of quads, turned by a quaternion and shaded by its normals. No library.

/** Rotate a vector by a quaternion (w, x, y, z), body to world. */
export function rotate([w, x, y, z], [a, b, c]) {
  const tx = 2 * (y * c - z * b);
  const ty = 2 * (z * a - x * c);
  const tz = 2 * (x * b - y * a);
  return [a + w * tx + y * tz - z * ty, b + w * ty + z * tx - x * tz, c + w * tz + x * ty - y * tx];
}

export const multiply = ([a, b, c, d], [e, f, g, h]) => [
  a * e - b * f - c * g - d * h, a * f + b * e + c * h - d * g, a * g - b * h + c * e + d * f, a * h + b * g - c * f + d * e,
];
export const conjugate = ([w, x, y, z]) => [w, -x, -y, -z];
export const angleBetween = (p, q) => {
  const r = multiply(conjugate(p), q);
  return 2 * Math.atan2(Math.hypot(r[1], r[2], r[3]), Math.abs(r[0]));
};

/** Roll, pitch, yaw in degrees (turns about x, y, z; applied in the order yaw, pitch, roll). */
export function euler([w, x, y, z]) {
  const deg = 180 / Math.PI;
  return [
    Math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)) * deg,
    Math.asin(Math.max(-1, Math.min(1, 2 * (w * y - z * x)))) * deg,
    Math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)) * deg,
  ];
}

// the instrument along its z axis, mm from the base of the back suite: [z, radius]; the tip is at 155
const PROFILE = [[-8, 7], [-6, 13], [22, 13], [28, 10], [92, 9], [98, 11], [124, 11], [130, 6], [134, 3.2], [150, 1.2], [155, 0.3]];
const SIDES = 14;
const CENTRE = 62;
export const TIP = [0, 0, 155 - CENTRE];

function quads() {
  const faces = [];
  for (let i = 0; i + 1 < PROFILE.length; i++) {
    const [z0, r0] = PROFILE[i];
    const [z1, r1] = PROFILE[i + 1];
    for (let k = 0; k < SIDES; k++) {
      const [a, b] = [k, k + 1].map((v) => (2 * Math.PI * v) / SIDES);
      const at = (r, angle, z) => [r * Math.cos(angle), r * Math.sin(angle), z - CENTRE];
      const middle = (a + b) / 2;
      const slope = Math.atan2(r0 - r1, z1 - z0);
      faces.push({
        points: [at(r0, a, z0), at(r0, b, z0), at(r1, b, z1), at(r1, a, z1)],
        normal: [Math.cos(middle) * Math.cos(slope), Math.sin(middle) * Math.cos(slope), Math.sin(slope)],
        part: i < 3 ? 0 : i < 5 ? 1 : i < 7 ? 0 : 2, band: k === 0,
      });
    }
  }
  const [z, r] = PROFILE[0];
  const rim = Array.from({ length: SIDES }, (_, k) => [r * Math.cos((2 * Math.PI * k) / SIDES), r * Math.sin((2 * Math.PI * k) / SIDES), z - CENTRE]);
  faces.push({ points: rim, normal: [0, 0, -1], part: 0, band: false });
  return faces;
}
const FACES = quads();

/** Where the eye is: seen along ``yaw`` (0: looking north, a quarter turn: looking west) from ``pitch`` above. */
export const camera = { yaw: 1.25, pitch: 0.3 };

/** World (x north, y west, z up) to the screen. */
function project([x, y, z], scale, cx, cy) {
  const { yaw, pitch } = camera;
  const u = x * Math.sin(yaw) - y * Math.cos(yaw);
  const depth = x * Math.cos(yaw) + y * Math.sin(yaw);
  const v = z * Math.cos(pitch) + depth * Math.sin(pitch);
  return [cx + u * scale, cy - v * scale, depth * Math.cos(pitch) - z * Math.sin(pitch)];
}

/** Turn the eye by dragging or with the arrow keys. */
export function orbit(element) {
  element.tabIndex = 0;
  element.style.cursor = "grab";
  element.style.touchAction = "pan-y"; // a finger turns it sideways and still scrolls the page up and down
  const turn = (dx, dy) => {
    camera.yaw -= dx * 0.008;
    camera.pitch = Math.max(-0.2, Math.min(1.3, camera.pitch + dy * 0.008));
  };
  element.addEventListener("pointermove", (event) => { if (event.buttons & 1) turn(event.movementX, event.movementY); });
  element.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: [12, 0], ArrowRight: [-12, 0], ArrowUp: [0, 8], ArrowDown: [0, -8] }[event.key];
    if (step) { event.preventDefault(); turn(...step); }
  });
}

export function drawInstrument(g, w, h, q, palette, ghost = null) {
  const scale = Math.min(w, h) / 215;
  const [cx, cy] = [w / 2, h * 0.5];
  const { yaw, pitch } = camera;
  const light3 = [-Math.cos(yaw + 0.6) * 0.75, -Math.sin(yaw + 0.6) * 0.75, 0.66 + pitch * 0.2];
  drawFloor(g, scale, cx, cy, palette);
  const look = [Math.cos(yaw) * Math.cos(pitch), Math.sin(yaw) * Math.cos(pitch), -Math.sin(pitch)];
  const faces = FACES.map((face) => ({ ...face, n: rotate(q, face.normal) }))
    .filter(({ n }) => n[0] * look[0] + n[1] * look[1] + n[2] * look[2] < 0.02).map((face) => {
    const points = face.points.map((p) => project(rotate(q, p), scale, cx, cy));
    const n = face.n;
    const light = 0.4 + 0.6 * Math.max(0, n[0] * light3[0] + n[1] * light3[1] + n[2] * light3[2]);
    return { points, light, part: face.part, band: face.band, depth: points.reduce((sum, p) => sum + p[2], 0) / points.length };
    }).sort((a, b) => b.depth - a.depth);
  for (const { points, light, part, band } of faces) {
    const base = band && part === 1 ? palette.mark : palette.parts[part];
    g.fillStyle = g.strokeStyle = `rgb(${base.map((v) => Math.round(v * light)).join(",")})`;
    g.lineWidth = 0.6;
    g.beginPath();
    points.forEach(([x, y], i) => (i ? g.lineTo(x, y) : g.moveTo(x, y)));
    g.closePath();
    g.fill();
    g.stroke();
  }
  for (const [axis, colour, label] of [[[1, 0, 0], palette.x, "x"], [[0, 1, 0], palette.y, "y"], [[0, 0, 1], palette.z, "z"]]) {
    const from = project(rotate(q, [0, 0, -CENTRE]), scale, cx, cy);
    const to = project(rotate(q, [axis[0] * 42, axis[1] * 42, axis[2] * 42 - CENTRE]), scale, cx, cy);
    g.strokeStyle = g.fillStyle = colour;
    g.lineWidth = 2;
    g.beginPath();
    g.moveTo(from[0], from[1]);
    g.lineTo(to[0], to[1]);
    g.stroke();
    g.font = `600 12px ${palette.mono}`;
    g.fillText(label, to[0] + 4, to[1] + 4);
  }
  const tip = project(rotate(q, TIP), scale, cx, cy);
  g.strokeStyle = palette.accent;
  g.lineWidth = 1.6;
  g.beginPath();
  g.arc(tip[0], tip[1], 6, 0, 7);
  g.stroke();
  if (ghost) {
    const old = project(rotate(ghost, TIP), scale, cx, cy);
    const base = project(rotate(ghost, [0, 0, -CENTRE]), scale, cx, cy);
    g.setLineDash([4, 4]);
    g.strokeStyle = palette.soft;
    g.beginPath();
    g.moveTo(base[0], base[1]);
    g.lineTo(old[0], old[1]);
    g.stroke();
    g.setLineDash([]);
  }
}

function drawFloor(g, scale, cx, cy, palette) {
  g.strokeStyle = palette.grid;
  g.lineWidth = 1;
  for (let i = -4; i <= 4; i++) {
    for (const line of [[[i * 25, -100, -90], [i * 25, 100, -90]], [[-100, i * 25, -90], [100, i * 25, -90]]]) {
      const [a, b] = line.map((p) => project(p, scale, cx, cy));
      g.beginPath();
      g.moveTo(a[0], a[1]);
      g.lineTo(b[0], b[1]);
      g.stroke();
    }
  }
  const north = project([112, 0, -90], scale, cx, cy);
  g.fillStyle = palette.soft;
  g.font = `600 11px ${palette.mono}`;
  g.fillText("N", north[0] - 4, north[1] + 4);
}
