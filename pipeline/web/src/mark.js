// Marking control points: one point, one photo, one click; the next photo follows automatically.
//
// For scripts: window.splatpipe.mark has ready (a promise), state(), goTo(pointName, photoName), screenAt([x, y]), the
// window pixel of a photo pixel, and settled(), a promise that everything is saved on disk and shown.

import { element, isLeft, showEstimate, showPhotos, showPoints } from "./mark/panels.js";
import { paintOver } from "./mark/crosses.js";
import { Photos, Picture } from "./mark/picture.js";
import { Outbox, fetchJson, post } from "./mark/server.js";

const $ = (id) => document.getElementById(id);
const CLOSE_ZOOM = 4; // screen pixels per photo pixel, if the position is well known
const ROOM = 2.8; // radii of uncertainty that the view shows
const KEYS = [
  ["Click", "mark the point; click again to correct it"],
  ["Arrows", "move the mark by a pixel; with Shift by a tenth, with Alt by ten"],
  ["Enter", "accept, and go to the next unmarked photo"],
  ["Del", "remove the mark; a detected one is recorded as not visible here"],
  ["X", "the point is not visible in this photo (press again to undo)"],
  ["N  P", "next, previous photo"],
  ["J  K", "next, previous point"],
  ["+  -  wheel", "zoom"],
  ["F  C", "the whole photo; back to the point"],
  ["U  Ctrl+Z", "undo"],
  ["R  Ctrl+Y", "redo"],
];

const state = { overview: null, detail: null, point: 0, requested: 0, photo: -1, moved: null, order: new Map(), wanted: 6, acting: Promise.resolve() };
const photos = new Photos();
const picture = new Picture($("canvas"), $("overall"), {
  click: (place) => row() && mark(place, false),
  paint: (context, view) => paintOver(context, view, row(), state.moved),
});
let outbox;

const row = (photo = state.photo) => state.detail?.photos.find((each) => each.photo === photo);
const pointName = () => state.overview.points[state.point].name;
const place = () => row()?.mark ?? state.moved ?? row()?.predicted;

async function begin() {
  state.overview = await fetchJson("api/mark");
  state.wanted = Number(localStorage.getItem("splatpipe.wanted")) || state.wanted;
  outbox = new Outbox(state.overview.file, numbers, onResult);
  await outbox.send();
  const first = state.overview.points.findIndex(needsMore);
  await choosePoint(Math.max(0, first));
}

function numbers({ point, photo }) {
  const at = (list, name) => list.findIndex((each) => each.name === name);
  return [at(state.overview.points, point), at(state.overview.photos, photo)];
}

const needsMore = (point) => point.marks < state.wanted && point.left > 0;

// The server's answer: applied unless changes of ours are still pending.
function onResult({ answer, refused }) {
  if (refused) hint(refused, true);
  if (answer && outbox.count === 0) take(answer);
  showSaved();
}

function take(answer) {
  state.overview = answer.overview;
  if (answer.detail && answer.detail.name === pointName()) setDetail(answer.detail);
  showAll();
}

// The order of a point's photos stays fixed while the point is open, so that nothing moves under the pointer.
function setDetail(detail) {
  const known = state.order.get(detail.name);
  if (known) detail.photos.sort((a, b) => known.indexOf(a.photo) - known.indexOf(b.photo));
  else state.order.set(detail.name, detail.photos.map((each) => each.photo));
  state.detail = detail;
}

// Until the point's photos are known and its photo is loaded, clicks apply to what is shown.
async function choosePoint(number, photo) {
  state.requested = number;
  const detail = await fetchJson(`api/mark/${number}`);
  if (state.requested !== number) return;
  state.point = number;
  state.order.delete(detail.name);
  setDetail(detail);
  const rows = detail.photos;
  const first = rows.find(isLeft) ?? rows.find((each) => each.mark) ?? rows[0];
  document.body.classList.remove("drawn");
  $("drawer").setAttribute("aria-expanded", "false");
  await choosePhoto(photo ?? first.photo);
}

async function choosePhoto(number) {
  state.photo = number;
  state.moved = null;
  hint("");
  const size = state.overview.photos[number];
  picture.show(null, size); // without a photo, nothing can be clicked
  showAll();
  try {
    const bitmap = await photos.get(number, size);
    if (state.photo !== number) return;
    picture.show(bitmap, size);
    home();
    const next = nextLeft();
    if (next) photos.get(next.photo, state.overview.photos[next.photo]).catch(() => 0);
  } catch (error) {
    if (state.photo === number) hint(error.message, true);
  }
}

function home() {
  const at = place();
  if (!at) return picture.fitAll();
  const { predicted, radius_px: radius, mark } = row();
  const room = Math.min(picture.width, picture.height) / (ROOM * Math.max(1, mark ? 1 : (radius ?? 1)));
  const inside = mark || (predicted[0] >= 0 && predicted[1] >= 0);
  picture.look(at[0], at[1], Math.min(CLOSE_ZOOM, inside ? room : room / 2));
}

// The next remaining photo after the one shown.
function nextLeft() {
  const rows = state.detail.photos;
  const at = rows.findIndex((each) => each.photo === state.photo);
  return [...rows.slice(at + 1), ...rows.slice(0, at)].find((each) => isLeft(each));
}

function send(change) {
  const photo = state.overview.photos[state.photo].name;
  outbox.add({ point: pointName(), photo, ...change });
}

function mark([x, y], nudge) {
  const size = state.overview.photos[state.photo];
  const inside = (value, most) => Math.round(Math.min(most, Math.max(0, value)) * 100) / 100;
  const here = row();
  here.mark = [inside(x, size.width), inside(y, size.height)];
  Object.assign(here, { hidden: false, found: false, agrees: true, residual_px: null });
  state.moved = null;
  hint("");
  send({ action: "mark", x: here.mark[0], y: here.mark[1], nudge });
  showAll();
}

function nudge(dx, dy) {
  const at = place() ?? [picture.x, picture.y];
  const to = [at[0] + dx, at[1] + dy];
  if (row().mark) mark(to, !row().found); // a detected target that is moved becomes the user's mark
  else state.moved = to;
  picture.keepInSight(to);
  picture.draw();
}

async function accept() {
  const here = row();
  if (!here.mark) {
    if (!state.moved) return hint("Click where the point is, or move the cross onto it with the arrows: the predicted position is not a measurement.");
    mark(state.moved, false);
  }
  await outbox.send();
  await onward();
}

// To the next photo of the point while it needs more marks, then to the next point that does.
async function onward() {
  const next = nextLeft();
  if (next && state.detail.photos.filter((each) => each.mark).length < state.wanted) return choosePhoto(next.photo);
  const { points } = state.overview;
  const order = [...points.keys()].map((k) => (state.point + 1 + k) % points.length);
  const other = order.find((k) => k !== state.point && needsMore(points[k]));
  if (other != null) return choosePoint(other);
  if (next) return choosePhoto(next.photo);
  const blind = state.detail.photos.every((each) => !each.predicted);
  return hint(blind ? "Its position in other photos cannot be predicted yet: choose one with N and P." : "Every point is marked in all photos where it is likely to be visible.");
}

function remove() {
  const here = row();
  if (!here.mark) return;
  const { found } = here; // the next georeferencing would detect it again: the file has to rule it out
  Object.assign(here, { mark: null, found: false, hidden: found, residual_px: null });
  send({ action: found ? "hide" : "unmark" });
  showAll();
  if (found) hint("The detected mark is no longer used: recorded as not visible. X undoes that.");
}

async function hide() {
  const here = row();
  here.hidden = !here.hidden;
  if (here.hidden) Object.assign(here, { mark: null, found: false, residual_px: null });
  send({ action: here.hidden ? "hide" : "unmark" });
  showAll();
  if (here.hidden) await onward();
}

async function turnBack(what) {
  await outbox.send();
  try {
    const answer = await post(`api/mark/${what}`, {});
    if (answer.point == null) return hint(`Nothing to ${what}.`);
    state.overview = answer.overview;
    if (answer.point !== state.point) await choosePoint(answer.point, answer.photo);
    else {
      setDetail(answer.detail);
      if (answer.photo !== state.photo) await choosePhoto(answer.photo);
      else showAll();
    }
  } catch (error) {
    hint(error.message, true);
  }
}

function step(by) {
  const rows = state.detail.photos;
  const at = rows.findIndex((each) => each.photo === state.photo);
  return choosePhoto(rows[(at + by + rows.length) % rows.length].photo);
}

const stepPoint = (by) => choosePoint((state.point + by + state.overview.points.length) % state.overview.points.length);

function hint(text, bad = false) {
  $("hint").textContent = text;
  $("hint").classList.toggle("bad", bad);
}

function showSaved() {
  const waiting = outbox?.count ?? 0;
  const node = $("saved");
  node.className = waiting ? (outbox.trouble ? "bad" : "busy") : "good";
  const many = `${waiting} change${waiting > 1 ? "s" : ""}`;
  node.textContent = !waiting ? "All saved" : outbox.trouble ? `${many} not saved: ${outbox.trouble} Kept here; retrying.` : "Saving…";
}

function showAll() {
  const { overview, detail } = state;
  showEstimate($("estimate"), overview);
  showPoints($("list"), overview, state.point, state.wanted, (number) => atOnce(() => choosePoint(number)));
  showFile();
  $("undo").disabled = !overview.can_undo && !outbox?.count;
  $("redo").disabled = !overview.can_redo;
  if (detail) {
    showPhotos(document.querySelector("#photos ol"), detail.photos, state.photo, (number) => atOnce(() => choosePhoto(number)));
    $("point").textContent = detail.name;
    const marked = detail.photos.filter((each) => each.mark && !each.found).length;
    const found = detail.photos.filter((each) => each.found).length;
    const left = detail.photos.filter(isLeft).length;
    $("about").textContent = `marked in ${marked},${found ? ` found in ${found},` : ""} ${left} to do`;
    $("photo").textContent = state.overview.photos[state.photo]?.name ?? "";
  }
  picture.draw();
  showSaved();
}

function showFile() {
  const wanted = element("select", { "aria-label": "Marks a point", onchange: (event) => setWanted(event.target.value) });
  for (const count of [4, 6, 8, 100]) {
    const text = count === 100 ? "every photo" : `${count} photos`;
    wanted.append(element("option", { value: count, selected: count === state.wanted }, text));
  }
  $("file").replaceChildren(
    element("p", {}, "Mark each point in ", wanted),
    element("p", {}, "Marks go into ", element("code", {}, state.overview.file), ` in ${state.overview.crs}.`),
    state.overview.command
      ? element("p", {}, "Then: ", element("code", {}, state.overview.command))
      : element("p", {}, "Then ", element("a", { href: "run" }, "go back"), " and apply the marks."), // of a node
  );
}

function setWanted(value) {
  state.wanted = Number(value);
  localStorage.setItem("splatpipe.wanted", value);
  showAll();
}

const actions = {
  left: () => nudge(-1, 0),
  right: () => nudge(1, 0),
  up: () => nudge(0, -1),
  down: () => nudge(0, 1),
  accept,
  remove,
  hide,
  home,
  next: () => step(1),
  previous: () => step(-1),
};

function onKey(event) {
  if (event.target.matches("select, input") || $("keys").open || !state.detail) return;
  const control = event.ctrlKey || event.metaKey;
  const size = event.shiftKey ? 0.1 : event.altKey ? 10 : 1;
  const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  const moves = { ArrowLeft: [-size, 0], ArrowRight: [size, 0], ArrowUp: [0, -size], ArrowDown: [0, size] };
  const plain = {
    Enter: accept, Delete: remove, Backspace: remove, x: hide, n: actions.next, p: actions.previous,
    j: () => stepPoint(1), k: () => stepPoint(-1), PageDown: () => stepPoint(1), PageUp: () => stepPoint(-1),
    u: () => turnBack("undo"), r: () => turnBack("redo"), c: home, f: () => picture.fitAll(),
    "+": () => picture.zoomBy(1.5), "=": () => picture.zoomBy(1.5), "-": () => picture.zoomBy(1 / 1.5), "?": help,
  };
  const turned = { z: event.shiftKey ? "redo" : "undo", y: "redo" };
  const act = control ? turned[key] && (() => turnBack(turned[key])) : moves[key] ? () => nudge(...moves[key]) : plain[key];
  if (!act) return;
  event.preventDefault();
  run(act);
}

// One after the other, however fast the keys come.
function run(act) {
  state.acting = state.acting.then(act).catch((error) => hint(error.message, true));
}

// Choosing from a list does not wait, but later actions wait for it.
function atOnce(act) {
  const done = act().catch((error) => hint(error.message, true));
  state.acting = Promise.all([state.acting, done]);
}

function help() {
  const rows = KEYS.map(([keys, text]) => element("tr", {}, element("th", {}, keys), element("td", {}, text)));
  const close = element("button", { onclick: () => $("keys").close() }, "Close");
  $("keys").replaceChildren(element("h2", {}, "Keys"), element("table", {}, ...rows), close);
  $("keys").showModal();
}

document.addEventListener("keydown", onKey);
$("pad").addEventListener("click", (event) => {
  const act = actions[event.target.closest("button")?.dataset.do];
  if (act && state.detail) run(act);
});
$("undo").addEventListener("click", () => run(() => turnBack("undo")));
$("redo").addEventListener("click", () => run(() => turnBack("redo")));
$("help").addEventListener("click", help);
$("drawer").addEventListener("click", () => {
  const open = document.body.classList.toggle("drawn");
  $("drawer").setAttribute("aria-expanded", String(open));
});
addEventListener("beforeunload", (event) => outbox?.count && event.preventDefault());

const ready = begin().catch((error) => hint(error.message, true));
window.splatpipe = {
  mark: {
    ready,
    state: () => ({ point: pointName(), photo: state.overview.photos[state.photo].name, overview: state.overview, detail: state.detail, waiting: outbox.count }),
    goTo: (point, photo) => choosePoint(...numbers({ point, photo })),
    screenAt: (at) => {
      picture.resize(); // the layout may have changed since the last frame
      const box = $("canvas").getBoundingClientRect();
      const [x, y] = picture.screenAt(at);
      return [x + box.left, y + box.top];
    },
    settled: async () => {
      await state.acting;
      await outbox.send();
      return new Promise((done) => requestAnimationFrame(() => done(outbox.count)));
    },
  },
};
