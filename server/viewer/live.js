// The live panel. Asks for nothing until it is opened, since the first request starts the live world. It steers the picture through the
// controls that are there already, as a hand would.
const at = (id) => document.getElementById(id);
const POLL_MS = 500;
const SLIDERS = { bounce_factor: "Bounces", sky_factor: "Sky", sun_factor: "Sun and moon", lights_factor: "Lamps" };
let followed = null;
let token = "";
let readFailed = false;

async function ask(method, path, body) {
  const headers = body === undefined ? {} : { "Content-Type": "application/json" };
  if (token) headers.Authorization = `Bearer ${token}`;
  const reply = await fetch(`v1/${path}`, { method, headers, body: body === undefined ? undefined : JSON.stringify(body) });
  if (reply.ok) return reply.json();
  at("live-token-row").hidden &&= reply.status !== 401;
  const problem = await reply.json().catch(() => ({ detail: reply.statusText }));
  throw new Error(problem.detail);
}

// Whatever fails is said, and the next thing is tried all the same.
async function tell(method, path, body) {
  try {
    const reply = await ask(method, path, body);
    // What a read says replaces only what a read that failed said.
    if (method !== "GET") at("live-status").textContent = `since tick ${reply.tick}`;
    else if (readFailed) at("live-status").textContent = "";
    if (method === "GET") readFailed = false;
    return reply;
  } catch (error) {
    at("live-status").textContent = error.message;
    if (method === "GET") readFailed = true;
    return null;
  }
}

function set(id, value) {
  if (at(id) === document.activeElement || at(id).value === String(value)) return false;
  at(id).value = value;
  return true;
}

function showClock(clock) {
  at("live-time").value = `${clock.time.slice(0, 10)} ${clock.time.slice(11, 19)}`;
  at("live-paused").checked = clock.paused;
  if (![...at("live-rate").options].some((option) => Number(option.value) === clock.rate)) at("live-rate").append(new Option(`${clock.rate} x`, clock.rate));
  set("live-rate", clock.rate);
}

function showPlayers(players) {
  if (!players.some((player) => player.id === followed)) followed = null;
  const list = at("live-players"), shown = JSON.stringify(players.map((player) => player.id));
  // Made anew only when somebody comes or goes: buttons that are replaced twice a second lose the keyboard's focus, and clicks.
  if (list.dataset.shown !== shown) list.replaceChildren(...players.map(({ id }) => playerRow(id)));
  list.dataset.shown = shown;
  players.forEach((player, i) => {
    const [follow, place] = list.children[i].children;
    follow.textContent = `${player.id === followed ? "following" : "follow"} ${player.id}`;
    follow.setAttribute("aria-pressed", String(player.id === followed));
    place.textContent = ` ${player.position.map((v) => v.toFixed(1)).join(", ")} m `;
  });
}

function playerRow(id) {
  const row = document.createElement("li"), follow = document.createElement("button"), gone = document.createElement("button");
  follow.type = gone.type = "button";
  follow.addEventListener("click", () => { followed = id === followed ? null : id; });
  gone.textContent = "remove";
  gone.addEventListener("click", () => tell("DELETE", `players/${encodeURIComponent(id)}`));
  row.append(follow, document.createElement("span"), gone);
  return row;
}

// The picture's own controls take the world's moment and the player's place.
function steer(player, clock, weather) {
  at("minutes").step = 1;
  const heading = player.heading_degrees * Math.PI / 180, [x, y, z] = player.position;
  const point = (...v) => v.map((c) => +c.toFixed(2)).join(",");
  if (![...at("weather").options].some((option) => option.value === weather)) {
    at("weather").querySelector("[data-live]")?.remove();
    const option = new Option("the live world's", weather);
    option.dataset.live = "";
    at("weather").append(option);
  }
  const changed = [
    set("date", clock.time.slice(0, 10)),
    set("minutes", Number(clock.time.slice(11, 13)) * 60 + Number(clock.time.slice(14, 16))),
    set("weather", weather),
  ].some(Boolean);
  const moved = [set("eye", point(x, y, z)), set("look", point(x + 20 * Math.sin(heading), y, z - 20 * Math.cos(heading)))].some(Boolean);
  if (changed) at("minutes").dispatchEvent(new Event("input"));
  if (moved) for (const id of ["eye", "look"]) at(id).dispatchEvent(new Event("change"));
}

let nextPoll = 0;

async function poll() {
  clearTimeout(nextPoll);  // of a panel that was closed and opened again meanwhile
  if (!at("live").open) return;
  const clock = await tell("GET", "clock");
  const players = clock && await tell("GET", "players");
  const weather = players && await tell("GET", "weather");
  if (weather) {
    showClock(clock);
    showPlayers(players.players);
    const cover = `${Math.round(weather.now.cloud_cover * 100)} % clouds, ${Math.round(weather.now.snow * 100)} % snow`;
    at("live-weather-now").value = `${weather.asked.weather ?? "changing by itself"}: ${cover}`;
    const player = players.players.find((p) => p.id === followed);
    if (player && !at("picture").classList.contains("waiting")) steer(player, clock, weather.now.text);
  }
  clearTimeout(nextPoll);
  nextPoll = setTimeout(poll, POLL_MS);
}

async function opened() {
  if (!at("live").open) return;
  at("live-status").textContent = "the live world starts …";
  readFailed = true;
  if (!at("live-weather").options.length) at("live-weather").replaceChildren(...[...at("weather").options].map((o) => new Option(o.value)));
  let settings = null;
  while (at("live").open && !(settings = await tell("GET", "settings"))) await new Promise((done) => { setTimeout(done, POLL_MS); });
  for (const name of Object.keys(SLIDERS)) if (settings) at(`live-${name}`).value = settings[name];
  poll();
}

for (const [name, label] of Object.entries(SLIDERS)) {
  const row = document.createElement("label"), slider = document.createElement("input");
  Object.assign(slider, { id: `live-${name}`, type: "range", min: 0, max: 4, step: 0.05, value: 1 });
  slider.addEventListener("change", () => tell("PUT", "settings", { [name]: Number(slider.value) }));
  row.append(`${label} `, slider);
  at("live-settings").append(row);
}
at("live").addEventListener("toggle", opened);
at("live-rate").addEventListener("change", () => tell("PUT", "clock", { rate: Number(at("live-rate").value) }));
at("live-paused").addEventListener("change", () => tell("PUT", "clock", { paused: at("live-paused").checked }));
at("live-jump").addEventListener("change", () => at("live-jump").value && tell("PUT", "clock", { time: at("live-jump").value }));
at("live-weather").addEventListener("change", () => tell("PUT", "weather", { weather: at("live-weather").value, blend_s: Number(at("live-blend").value) || 0 }));
at("live-add").addEventListener("click", () => tell("POST", "players", { seed: Math.floor(Math.random() * 1e6) }));
at("live-token").addEventListener("change", () => { token = at("live-token").value.trim(); });
