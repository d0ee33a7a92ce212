// The live view of training: polls the server every two seconds while the page is visible.
//
// For scripts: window.splatpipe.live.state() is the server's last answer, and updates the number of changed answers.

import uPlot from "uplot";

const $ = (id) => document.getElementById(id);
const EVERY_MS = 2000;
const NAMES = { waiting: "waits", running: "at work", done: "done", reused: "reused", failed: "failed" };
const CURVES = { loss: "Loss", gaussians: "Gaussians" };
const MODELS = {
  initial: "the start, before training",
  coarse: "the whole scene, from which the blocks continue",
  checkpoint: "iteration",
  model: "finished, iteration",
};

let latest = null;
let updates = 0;
let view = null; // name of the photo shown
let pictured = { address: "" };
const plots = {};

async function ask() {
  try {
    const answer = await fetch("api/live");
    if (!answer.ok) throw new Error();
    const text = await answer.text();
    const next = JSON.parse(text);
    if (!latest || JSON.stringify({ ...next, now_s: 0 }) !== JSON.stringify({ ...latest, now_s: 0 })) updates += 1;
    latest = next;
    show();
  } catch {
    $("state").textContent = "The server does not answer.";
    $("state").className = "state failed";
  }
  setTimeout(wait, EVERY_MS);
}

function wait() {
  if (document.hidden) document.addEventListener("visibilitychange", ask, { once: true });
  else ask();
}

function duration(seconds) {
  if (seconds < 90) return `${Math.max(1, Math.round(seconds))} s`;
  const minutes = Math.round(seconds / 60);
  return minutes < 90 ? `${minutes} min` : `${Math.floor(minutes / 60)} h ${minutes % 60} min`;
}

const make = (tag, name, text) => Object.assign(document.createElement(tag), { className: name, textContent: text });

function show() {
  const running = latest.stages.find((stage) => stage.state === "running");
  const failed = latest.stages.find((stage) => stage.state === "failed");
  showState(running, failed);
  $("stages").replaceChildren(
    ...latest.stages.map((stage) => {
      const item = make("li", stage.state, stage.name);
      item.title = NAMES[stage.state] + (stage.seconds == null ? "" : `, ${duration(stage.seconds)}`);
      return item;
    }),
  );
  showProgress(running);
  showViews();
  showCurves();
  $("notes").replaceChildren(
    ...latest.notes.toReversed().map((note) => make("li", note.kind, [`${note.stage}:`, note.message, note.hint].filter(Boolean).join(" "))),
  );
}

function showState(running, failed) {
  const all = latest.stages.length > 0 && latest.stages.every((stage) => ["done", "reused"].includes(stage.state));
  const [kind, text] = latest.at_work
    ? ["running", running ? running.name : "beginning"]
    : failed
      ? ["failed", `${failed.name}: ${failed.message}`]
      : all
        ? ["done", "finished"]
        : ["failed", "not at work"];
  $("state").className = `state ${kind}`;
  $("state").textContent = text;
  const after = latest.left_after_s ? `, ${duration(running.seconds_left + latest.left_after_s)} with those that follow` : "";
  $("left").textContent =
    latest.at_work && running?.seconds_left != null ? `${duration(running.seconds_left)} left in ${running.name}${after}` : "";
}

function showProgress(running) {
  const stage = latest.at_work ? running : null;
  const share = stage?.total ? Math.min(1, stage.done / stage.total) : 0;
  $("progress").hidden = !stage?.total;
  $("progress").setAttribute("aria-valuenow", String(Math.round(100 * share)));
  $("progress").firstElementChild.style.width = `${100 * share}%`;
  const count = (value) => value.toLocaleString("en", { maximumFractionDigits: 1 });
  $("progress").lastElementChild.textContent = stage ? `${stage.what}: ${count(stage.done)} of ${count(stage.total)} ${stage.unit}` : "";
}

function showViews() {
  const select = $("view");
  const names = latest.views.map((each) => each.name + (each.held_out ? " (held out)" : ""));
  if (names.join() !== [...select.options].map((option) => option.textContent).join()) {
    select.replaceChildren(...latest.views.map((each, k) => Object.assign(make("option", "", names[k]), { value: each.name })));
  }
  view = latest.views.some((each) => each.name === view) ? view : (latest.views.find((each) => each.held_out) ?? latest.views[0])?.name;
  if (view) select.value = view;
  const number = latest.views.findIndex((each) => each.name === view);
  const model = latest.model;
  for (const id of ["view", "previous", "next"]) $(id).disabled = number < 0;
  $("nothing").hidden = Boolean(model);
  $("iteration").textContent = model ? modelLabel(model) : "";
  $("viewer").hidden = !model?.in_3d;
  $("viewer").href = `${$("viewer").dataset.folder}/live/${model?.stamp}/viewer.html`;
  if (model && number >= 0) picture(model.stamp, number);
}

function modelLabel(model) {
  const count = ["initial", "coarse"].includes(model.kind) ? "" : ` ${model.iteration?.toLocaleString("en")}`;
  return `${model.block ? `block ${model.block}, ` : ""}${MODELS[model.kind]}${count}`;
}

// The previous image stays until the new one has loaded; one at a time.
async function picture(stamp, number) {
  const address = `live/${stamp}/${number}`;
  if (pictured.address === address) return;
  const mine = { address };
  pictured = mine;
  try {
    for (const what of ["render", "photo"]) {
      const image = new Image();
      image.src = `${address}/${what}.jpg`;
      await image.decode();
      if (pictured !== mine) return;
      $(what).src = image.src;
      $(what).hidden = false;
    }
  } catch {
    if (pictured === mine) pictured = { address: "" }; // the model has changed: the next answer has the new stamp
  }
}

function showCurves() {
  for (const [name, points] of Object.entries(latest.curves)) {
    const node = $(name);
    if (!node || !points.length) continue;
    node.previousElementSibling.textContent = CURVES[name] + partLabel(latest.curves_of);
    const data = [points.map((point) => point[0]), points.map((point) => point[1])];
    plots[name] ??= plot(node, name);
    plots[name].setData(data);
  }
}

function partLabel(stage) {
  return stage === "blocks" ? ", before blocks" : stage.includes(".") ? `, block ${stage.split(".")[1]}` : "";
}

function plot(node, name) {
  const colour = getComputedStyle(document.documentElement).getPropertyValue("--accent").trim();
  const value = (_, each) => (each == null ? "" : each.toLocaleString("en", { maximumFractionDigits: name === "loss" ? 4 : 0 }));
  const size = () => ({ width: Math.max(240, node.clientWidth), height: 220 });
  const made = new uPlot(
    {
      ...size(),
      scales: { x: { time: false } },
      series: [{ label: "iteration" }, { label: name, stroke: colour, width: 1.5, value, points: { show: false } }],
      axes: [{ grid: { stroke: "#e6eaee" } }, { size: 62, grid: { stroke: "#e6eaee" }, values: (_, ticks) => ticks.map((tick) => tick.toLocaleString("en")) }],
    },
    [[], []],
    node,
  );
  addEventListener("resize", () => made.setSize(size()));
  return made;
}

function choose(by) {
  const at = latest.views.findIndex((each) => each.name === view);
  view = latest.views[(at + by + latest.views.length) % latest.views.length].name;
  showViews();
}

$("view").addEventListener("change", (event) => {
  view = event.target.value;
  showViews();
});
$("previous").addEventListener("click", () => choose(-1));
$("next").addEventListener("click", () => choose(1));
document.addEventListener("keydown", (event) => {
  if (event.target.matches("select") || !latest?.views.length) return;
  if (event.key === "ArrowLeft") choose(-1);
  if (event.key === "ArrowRight") choose(1);
});

window.splatpipe = { live: { state: () => latest, updates: () => updates } };
ask();
