"use strict";

const SHOWN = 600;
const SIGNS = { healthy: "✓", suspected: "?", isolated: "✕", probation: "◔" };
const STATES = {
  healthy: "healthy", suspected: "suspected", isolated: "isolated: not part of the estimate",
  probation: "on probation: not part of the estimate yet",
};
const byId = (id) => document.getElementById(id);
const page = { token: "", rows: [], charts: [], labels: null, last: 0, wait: 500, lost: false, dirty: false };

/* ---- the door ---- */

function takeToken() {
  const inAddress = new URLSearchParams(location.hash.slice(1)).get("token");
  if (inAddress) {
    sessionStorage.setItem("token", inAddress);
    history.replaceState(null, "", location.pathname);
  }
  page.token = sessionStorage.getItem("token") || "";
}

function shut(reason) {
  sessionStorage.removeItem("token");
  page.token = "";
  byId("content").hidden = true;
  byId("reset").hidden = true;
  byId("door").hidden = false;
  byId("refused").textContent = reason;
  byId("token").focus();
}

function open() {
  byId("door").hidden = true;
  byId("content").hidden = false;
  byId("reset").hidden = false;
}

/* ---- the connection ---- */

function connect() {
  const scheme = location.protocol === "https:" ? "wss" : "ws";
  const socket = new WebSocket(`${scheme}://${location.host}/ws`);
  socket.addEventListener("open", () => socket.send(JSON.stringify({ token: page.token })));
  socket.addEventListener("message", (message) => {
    page.wait = 500;
    page.lost = false;
    take(JSON.parse(message.data));
  });
  socket.addEventListener("close", (closed) => {
    if (closed.code === 4401) return shut("That is not the token.");
    // 4429, too many wrong tokens or pages: others' doing, so the token is kept and tried again
    chip("connection", closed.code === 4429 ? "refused for now, reconnecting" : "reconnecting", "bad");
    page.lost = true;
    setTimeout(connect, page.wait);
    page.wait = Math.min(2 * page.wait, 10000);
    return undefined;
  });
}

function take(message) {
  if (message.labels) {
    open();
    begin(message.labels);
    page.rows = [];
  }
  if (message.rows && message.rows.length) {
    page.rows = page.rows.concat(message.rows).slice(-SHOWN);
    page.last = performance.now();
    page.dirty = true;
  }
  if (message.events) showEvents(message.events);
  if (message.trouble !== undefined) {
    byId("trouble").hidden = !message.trouble;
    byId("trouble").textContent = message.trouble;
  }
}

async function post(path, content) {
  const answer = await fetch(path, {
    method: "POST",
    headers: { Authorization: `Bearer ${page.token}`, "Content-Type": "application/json" },
    body: JSON.stringify(content),
  });
  return answer.ok;
}

/* ---- what is shown ---- */

function begin(labels) {
  if (page.labels && JSON.stringify(page.labels) === JSON.stringify(labels)) return;
  page.labels = labels;
  byId("plant").textContent = labels.plant;
  document.title = `${labels.plant} · holdfast`;
  page.charts = [];
  for (const id of ["statistic", "attacks", "states"]) byId(id).replaceChildren();
  const add = (id, name, read) => page.charts.push(new Chart(byId(id), name, read));
  add("statistic", "statistic and its threshold", (row) => (
    { value: row.statistic, limit: row.threshold, alarm: row.alarm }));
  for (const [id, prefix, names] of [["attacks", "d", labels.attacks], ["states", "x", labels.states]]) {
    for (const name of names) {
      add(id, name, (row) => ({ value: row[`${prefix}:${name}`], sd: row[`${prefix}_sd:${name}`] }));
    }
  }
  byId("attack-section").hidden = labels.attacks.length === 0;
  byId("sensors").replaceChildren(...labels.outputs.map((name) => {
    const item = document.createElement("li");
    const title = document.createElement("b");
    title.textContent = name;
    item.append(title, document.createElement("span"));
    return item;
  }));
}

function chip(id, text, kind) {
  const found = byId(id);
  if (found.textContent !== text) found.textContent = text;
  found.className = `chip ${kind}`;
  found.hidden = false;
}

/* The last row with an alarm, as long as its event lasts: a banner that flickers is not read. */
function lastAlarm() {
  const hold = Math.max(10, Math.round(1 / page.labels.dt));
  const newest = page.rows[page.rows.length - 1].frame;
  for (let i = page.rows.length - 1; i >= 0 && newest - page.rows[i].frame < hold; i -= 1) {
    if (page.rows[i].alarm) return page.rows[i];
  }
  return null;
}

function draw() {
  if (page.rows.length && !byId("content").hidden) {
    const silent = (performance.now() - page.last) / 1000;
    if (!page.lost) {
      if (silent < 2) chip("connection", "● live", "good");
      else chip("connection", `no row for ${Math.round(silent)} s`, "warn");
    }
  }
  if (page.dirty) {
    page.dirty = false;
    const row = page.rows[page.rows.length - 1];
    for (const chart of page.charts) chart.draw(page.rows);
    chip("mode", row.mode, row.mode === "normal" ? "good" : "bad");
    const items = byId("sensors").children;
    page.labels.outputs.forEach((name, i) => {
      const state = row[`sensor:${name}`];
      items[i].className = state;
      items[i].lastChild.textContent = `${SIGNS[state]} ${STATES[state]}`;
    });
    const banner = byId("alarm");
    const alarmed = lastAlarm();
    const text = alarmed ? `⚠ Alarm: ${alarmed.reason}` : "";
    if (banner.textContent !== text) banner.textContent = text;
    banner.hidden = !text;
  }
}

const KINDS = {
  alarm: "Alarm", sensor: "Sensor", clock: "Clock", source: "Silence", mode: "Mode",
  service: "Service",
};

function showEvents(events) {
  byId("no-events").hidden = events.length > 0;
  const known = new Map();
  for (const row of byId("event-rows").children) known.set(row.dataset.id, row);
  const rows = events.map((event) => {
    const key = `${event.id}:${event.acknowledged ? event.acknowledged.who : ""}`;
    return known.get(key) || eventRow(event, key);
  });
  // only what changes is moved: a button that has the focus keeps it
  const body = byId("event-rows");
  const kept = new Set(rows);
  const focused = body.contains(document.activeElement);
  for (const row of [...body.children]) if (!kept.has(row)) row.remove();
  rows.forEach((row, i) => {
    if (body.children[i] !== row) body.insertBefore(row, body.children[i] || null);
  });
  // its row has been replaced; another button would be too easily pressed by mistake
  if (focused && !body.contains(document.activeElement)) byId("events").focus();
}

function eventRow(event, key) {
  const row = document.createElement("tr");
  row.dataset.id = key;
  const wanted = event.state !== "end" && ["alarm", "sensor", "mode"].includes(event.kind);
  row.className = wanted && !event.acknowledged ? "open" : "";
  const time = event.time === null ? event.written.slice(11, 19) : `${short(event.time)} s`;
  const excess = event.statistic === null ? "" : ` (${short(event.statistic)} of ${short(event.threshold)})`;
  const what = `${KINDS[event.kind] || event.kind}: ${event.state}`;
  for (const text of [time, what, event.subject, event.reason + excess]) {
    const cell = document.createElement("td");
    cell.textContent = text;
    row.append(cell);
  }
  const seen = document.createElement("td");
  if (event.acknowledged) {
    seen.textContent = `✓ ${event.acknowledged.who}, ${event.acknowledged.at.slice(11, 19)}`;
  } else if (wanted) {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = "Acknowledge";
    button.setAttribute("aria-label", `Acknowledge ${what} ${event.subject} at ${time}`);
    button.addEventListener("click", () => acknowledge(event.id));
    seen.append(button);
  }
  row.append(seen);
  return row;
}

async function acknowledge(id) {
  let who = localStorage.getItem("who");
  if (!who) {
    who = prompt("Your name, for the event log:");
    if (!who || !who.trim()) return;
    localStorage.setItem("who", who.trim());
  }
  await post("api/acknowledge", { id, who });
}

/* ---- begin ---- */

byId("door").addEventListener("submit", (submitted) => {
  submitted.preventDefault();
  page.token = byId("token").value;
  sessionStorage.setItem("token", page.token);
  byId("token").value = "";
  byId("refused").textContent = "";
  connect();
});
byId("reset").addEventListener("click", async () => {
  if (confirm("Begin the estimate anew? What it knows is forgotten.")) await post("api/reset", {});
});
takeToken();
setInterval(draw, 250);
if (page.token) connect();
else shut("");
