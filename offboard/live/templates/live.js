// Fills the page from server-sent events; draws at most twice a second.
const KEPT = 3000;
let rows = [], texts = [], newest = null, flight = {}, changed = false;
const AUTHORITY = {free: "not asked", asked: "asked", ours: "offboard", handed: "handed over",
  lost: "given up"};
const $ = (name) => document.getElementById(name);
const number = (value, digits, unit, scale = 1) =>
  value === null ? "–" : `${(scale * value).toFixed(digits)} ${unit}`;

// Label of a value -> its text from a snapshot. The id of its element is the label with "_" for " "
const VALUES = {
  phase: (now) => `${now.phase}, ${number(now.in_phase_s, 1, "s")}`,
  time: (now) => number(now.time_s, 1, "s"),
  mode: (now) => `${now.mode || "unknown"}, ${now.armed ? "armed" : "disarmed"}`,
  authority: (now) => AUTHORITY[now.authority] ?? now.authority,
  failsafe: (now) => now.failsafe === "fly" ? "none" : `${now.failsafe}: ${now.failsafe_row}`,
  "position error": (now) => number(now.position_error_m, 3, "m"),
  "link age": (now) => number(now.telemetry_age_s, 0, "ms", 1e3),
  "link delay": (now) => number(now.link_delay_s, 0, "ms", 1e3),
  "missed decisions": (now) => now.missed_decisions,
  "skipped ticks": (now) => now.skipped_ticks,
  computer: (now) => now.computer || "keeps up",
  battery: (now) => number(now.battery, 0, "%", 100),
};
const shown = Object.entries(VALUES).map(([label, text]) => {
  const [name, value] = ["dt", "dd"].map((kind) => document.createElement(kind));
  [name.textContent, value.textContent, value.id] = [label, "–", label.replaceAll(" ", "_")];
  $("values").append(name, value);
  return [value, text];
});

function tell() {
  for (const [value, text] of shown) value.textContent = text(newest);
  $("texts").replaceChildren(...[...texts].reverse().map(({ time_s, text }) => {
    const item = document.createElement("li");
    item.textContent = `${time_s.toFixed(2)} s  ${text}`;
    return item;
  }));
}

function tellFlight() {
  if (flight.title) {
    document.title = `Live: ${flight.title}`;
    document.querySelector("h1").textContent = flight.title;
  }
  if (flight.report) $("report").textContent = `report, in some seconds: ${flight.report}`;
}

// rounded to 0.1 mm, so that the axis of a vehicle at rest does not show nanometres
const column = (name, axis) => rows.map((row) =>
  row[name] ? Math.round(1e4 * row[name][axis]) / 1e4 : null);
function redraw() {
  if (!changed || !newest || !figures.every((figure) => figure.dataset.drawn)) return;
  changed = false;
  tell();
  const [time, down] = [rows.map((row) => row.time_s), column("position_ned_m", 2)];
  const [north, east] = [column("position_ned_m", 0), column("position_ned_m", 1)];
  Plotly.restyle("plan", {
    x: [column("reference_ned_m", 1), east, east.slice(-1)],
    y: [column("reference_ned_m", 0), north, north.slice(-1)],
  }, [0, 1, 2]);
  Plotly.restyle("curves", {
    x: [time, time, time],
    y: [down.map((value) => value === null ? null : -value),
        rows.map((row) => row.position_error_m),
        rows.map(({ telemetry_age_s: age_s }) =>
          age_s === null ? null : Math.round(1e4 * age_s) / 10)],
  });
}

function take(message) {
  if (message.type === "history") {
    ({ rows, texts, newest, flight } = message);
    tellFlight();
  } else if (message.type === "announcement") {
    texts.push(message);
  } else if (message.type === "flight") {
    Object.assign(flight, message);
    tellFlight();
  } else {
    newest = message;
    rows.push(message);
    if (rows.length > KEPT) rows.shift();
  }
  changed = true;
}

const source = new EventSource("events");
source.onopen = () => { $("connection").textContent = "connected"; };
source.onerror = () => { $("connection").textContent = "connection lost"; };
source.onmessage = (event) => take(JSON.parse(event.data));
source.addEventListener("end", () => {
  source.close();
  redraw();
  $("connection").textContent = flight.verdict || "the flight has ended";
});
setInterval(redraw, 500);
for (const query of [dark, narrow]) query.addEventListener("change", () => { changed = true; });
