// The viewer asks for one picture at a time and never queues more than the newest wish.
const at = (id) => document.getElementById(id);
const camera = { eye: [0, 0, 0], look: [0, 0, 0] };
let busy = false;
let wanted = false;

const sub = (a, b) => a.map((v, i) => v - b[i]);
const add = (a, b, s = 1) => a.map((v, i) => v + s * b[i]);
const unit = (a) => { const n = Math.hypot(...a) || 1; return a.map((v) => v / n); };
const parse = (text) => text.split(",").map(Number);
const show = (v) => v.map((c) => +c.toFixed(2)).join(",");

function moment() {
  const minutes = Number(at("minutes").value);
  const clock = `${String(Math.floor(minutes / 60)).padStart(2, "0")}:${String(minutes % 60).padStart(2, "0")}`;
  at("time-shown").value = clock;
  return at("date").value ? `${at("date").value}T${clock}` : clock;
}

function say(text, kind = "") {
  at("status").textContent = text;
  at("status").className = kind;
}

async function ask(path) {
  const reply = await fetch(path);
  if (reply.ok) return reply;
  const problem = await reply.json().catch(() => ({ detail: reply.statusText }));
  throw new Error(problem.detail);
}

async function refresh() {
  wanted = true;
  if (busy) return;
  busy = true;
  at("picture").classList.add("waiting");
  say("drawing …");
  while (wanted) {
    wanted = false;
    at("fov-shown").value = `${at("fov").value}°`;
    const light = new URLSearchParams({ time: moment(), weather: at("weather").value });
    const view = new URLSearchParams({ ...Object.fromEntries(light), eye: at("eye").value, look: at("look").value,
      fov: at("fov").value, width: 960, gi: at("gi").value });
    const started = performance.now();
    try {
      showSun(await (await ask(`v1/lighting?${light}`)).json());
      const picture = await (await ask(`v1/preview.png?${view}`)).blob();
      URL.revokeObjectURL(at("picture").src);
      at("picture").src = URL.createObjectURL(picture);
      say(`drawn in ${Math.round(performance.now() - started)} ms`);
    } catch (error) {
      say(error.message, "failed");
    }
  }
  at("picture").classList.remove("waiting");
  busy = false;
}

function showSun(light) {
  const luminance = ([r, g, b]) => 0.2126 * r + 0.7152 * g + 0.0722 * b;
  const lux = (rgb) => `${luminance(rgb).toLocaleString("en", { maximumSignificantDigits: 3 }).replaceAll(",", "\u202f")} lx`;
  const elevation = (d) => `${(Math.asin(Math.max(-1, Math.min(1, d[1]))) * 180 / Math.PI).toFixed(1)}°`;
  const rows = {
    "Sun": lux(light.sun.irradiance), "Sun's elevation": elevation(light.sun.direction),
    "Moon": lux(light.moon.irradiance), "Moon's elevation": elevation(light.moon.direction),
    "Open sky, upwards": lux(light.sky_cube[2]), "Exposure for the sky": `EV ${light.exposure.toFixed(1)}`,
  };
  at("sun").replaceChildren(...Object.entries(rows).flatMap(([name, value]) => {
    const term = document.createElement("dt"), text = document.createElement("dd");
    term.textContent = name;
    text.textContent = value;
    return [term, text];
  }));
}

function setCamera(eye, look) {
  Object.assign(camera, { eye, look });
  at("eye").value = show(eye);
  at("look").value = show(look);
}

function move(forward, side, up) {
  const ahead = unit(sub(camera.look, camera.eye));
  const right = unit([-ahead[2], 0, ahead[0]]);
  const step = add(add(ahead.map((v) => v * forward), right, side), [0, 1, 0], up);
  setCamera(add(camera.eye, step), add(camera.look, step));
  refresh();
}

function turn(dx, dy) {
  const ahead = sub(camera.look, camera.eye);
  const distance = Math.hypot(...ahead);
  const yaw = Math.atan2(ahead[2], ahead[0]) + dx;
  const pitch = Math.max(-1.5, Math.min(1.5, Math.asin(ahead[1] / distance) + dy));
  const next = [Math.cos(pitch) * Math.cos(yaw), Math.sin(pitch), Math.cos(pitch) * Math.sin(yaw)];
  setCamera(camera.eye, add(camera.eye, next, distance));
  refresh();
}

function listen() {
  for (const id of ["minutes", "date", "weather", "gi", "fov"]) at(id).addEventListener("input", refresh);
  for (const id of ["eye", "look"]) {
    at(id).addEventListener("change", () => {
      const place = parse(at(id).value);
      if (place.length === 3 && place.every(Number.isFinite)) {
        camera[id] = place;
        refresh();
      } else {
        at(id).value = show(camera[id]);
        say("expected three numbers, x,y,z in metres, such as 14,3,68", "failed");
      }
    });
  }
  at("controls").addEventListener("submit", (event) => event.preventDefault());
  const keys = { w: [4, 0, 0], s: [-4, 0, 0], a: [0, -4, 0], d: [0, 4, 0], e: [0, 0, 4], q: [0, 0, -4] };
  addEventListener("keydown", (event) => {
    // Sliders have no use for letters; what is typed into the others is theirs.
    if (event.target.matches("input:not([type=range]), select") || event.ctrlKey || event.metaKey || event.altKey) return;
    const step = keys[event.key.toLowerCase()];
    if (step) move(...step);
  });
  at("steps").addEventListener("click", (event) => {
    const step = keys[event.target.dataset.key];
    if (step) move(...step);
  });
  let last = null;
  at("picture").addEventListener("pointerdown", (event) => {
    event.preventDefault();
    at("picture").setPointerCapture(event.pointerId);
    last = [event.clientX, event.clientY];
  });
  at("picture").addEventListener("pointermove", (event) => {
    if (!last) return;
    turn((last[0] - event.clientX) * 0.004, (event.clientY - last[1]) * 0.004);
    last = [event.clientX, event.clientY];
  });
  for (const end of ["pointerup", "pointercancel"]) at("picture").addEventListener(end, () => { last = null; });
}

async function start() {
  const world = await (await ask("v1/world")).json();
  at("name").textContent = world.name;
  at("date").value = world.location.date;
  at("weather").replaceChildren(...world.weather.map((name) => new Option(name)));
  // The first view: from beyond the southern edge, or 500 m, a little below the highest roofs, over the middle.
  const { minimum: low, maximum: high } = world.bounds;
  const middle = low.map((v, i) => (v + high[i]) / 2);
  const reach = Math.min(Math.max(high[2] - low[2], high[0] - low[0]), 500) / 2;
  setCamera([middle[0] + 0.7 * reach, low[1] + 0.8 * (high[1] - low[1]), middle[2] + 1.7 * reach], [middle[0], middle[1] * 0.6, middle[2]]);
  listen();
  refresh();
}

start().catch((error) => say(error.message, "failed"));
