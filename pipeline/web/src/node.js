// The page of `splatpipe node`: folders of photos come in, the check speaks, runs go through the queue, results go out.

import { element } from "./mark/panels.js";
import { JobCard } from "./node/card.js";
import { UnfitDropError, capture, droppedFiles, plainFiles } from "./node/folder.js";
import { RefusedError, getJson, postJson } from "./node/server.js";
import { Upload } from "./node/upload.js";
import { count, size } from "./node/words.js";

const POLL_MS = 2000, POLL_HIDDEN_MS = 15_000;
const ENDED = ["done", "failed", "cancelled"];
const SECTIONS = { uploading: "prepared", waiting: "queued", running: "queued", marks: "queued", done: "ended", failed: "ended", cancelled: "ended" };

const by = (id) => document.getElementById(id);
const cards = new Map();
let node = null; // what the node said last of itself
let target = null; // the card that chosen files are for; null for a new one

const page = {
  offered: [],

  choose(card) {
    target = card;
    by("folder").click();
  },

  resume: (card) => upload(card),

  check: (card) => attempt(card, () => postJson(`api/check/${card.uuid}`, {})),

  without(card) {
    const refused = new Set(card.upload.refused.map(({ name }) => name));
    card.upload.files = card.upload.files.filter(({ name }) => !refused.has(name));
    card.upload.refused = [];
    uploaded(card);
  },

  start: (card) => attempt(card, async () => {
    if (invalid(card)) return;
    const options = card.form().values();
    await postJson(`api/start/${card.uuid}`, { name: card.name, options, pause: card.pause?.checked === true });
    card.upload = null;
    card.heading.focus();
  }),

  cancel: (card) => attempt(card, () => postJson("task/cancel", { uuid: card.uuid })),

  repeat: (card, { form = false, pause = false }) => attempt(card, async () => {
    if (form && invalid(card)) return;
    await postJson(`api/again/${card.uuid}`, { options: form ? card.form().values() : null, pause });
    card.repeating = false;
    card.heading.focus();
  }),

  async remove(card) {
    if (!(await confirmed(card))) return;
    card.upload?.stop();
    await attempt(card, () => postJson(`api/remove/${card.uuid}`));
  },

  async log(card, lines) {
    return getJson(`task/${card.uuid}/output?line=-${lines}`);
  },
};

/** Do what a button says; what is refused is said in the card. */
async function attempt(card, action) {
  try {
    await action();
    card.say("");
  } catch (error) {
    if (!(error instanceof RefusedError)) throw error;
    card.say(error.message);
  }
  await refresh();
}

function invalid(card) {
  const wrong = card.form().wrong;
  for (let above = wrong?.closest("details"); above; above = null) above.open = true;
  wrong?.reportValidity();
  return wrong != null;
}

function confirmed(card) {
  const dialog = by("confirm");
  by("confirm_text").textContent = `Its ${count(card.task.photos, "photo")} and results on this node are deleted. Your own files stay as they are.`;
  by("confirm_title").textContent = `Remove “${card.task.name}”?`;
  dialog.returnValue = "";
  dialog.showModal();
  return new Promise((resolve) => dialog.addEventListener("close", () => resolve(dialog.returnValue === "remove"), { once: true }));
}

// What comes in.

/** Take files, which may still be read from a folder (a promise), into a card; null for the one that they belong to. */
async function take(files, into = null) {
  const busy = by("reading");
  try {
    busy.textContent = "Reading the folder…";
    const found = await files;
    await ready;
    busy.textContent = "";
    await begin(capture(found, node.accepts), into);
  } catch (error) {
    if (!(error instanceof UnfitDropError || error instanceof RefusedError || error instanceof DOMException)) throw error;
    busy.textContent = error instanceof DOMException ? "The folder cannot be read: is the card still in?" : error.message;
  }
}

async function begin(found, into) {
  const { photos, files, title, others } = found;
  if (!photos.length) {
    const only = others.length ? ` It has ${count(others.length, "file")} of other kinds.` : "";
    throw new UnfitDropError(`There are no photos in this.${only} Photos are ${node.accepts.photos.join(", ")}.`);
  }
  const bytes = files.reduce((sum, { file }) => sum + file.size, 0);
  if (node.max_photos && photos.length > node.max_photos) {
    throw new UnfitDropError(`These are ${count(photos.length, "photo")}; this node takes at most ${node.max_photos.toLocaleString("en")} a job.`);
  }
  if (bytes > node.free_bytes) {
    throw new UnfitDropError(`These are ${size(bytes)}, and the node's disk has ${size(node.free_bytes)} free: remove old jobs first.`);
  }
  const card = into ?? (await unfinished(found)) ?? (await made(title || "photos", files.length, bytes));
  card.left = others;
  card.upload?.stop();
  card.upload = new Upload(card.uuid, files, () => card.update(card.task));
  card.root.scrollIntoView({ block: "nearest" });
  card.heading.focus({ preventScroll: true });
  await upload(card);
}

/** The card of an upload that was begun with this folder, perhaps by a page that is closed; undefined if there is none. */
async function unfinished({ title, files }) {
  for (const card of cards.values()) {
    if (card.task.state !== "uploading" || card.upload?.running || card.task.name !== title) continue;
    const have = (await getJson(`api/files/${card.uuid}`)).files;
    if (files.some(({ name, file }) => have[name] === file.size)) return card;
  }
  return undefined;
}

async function made(name, files, bytes) {
  const { uuid } = await postJson("api/new", { name, files, bytes });
  while (!cards.has(uuid)) await refresh().then(() => cards.has(uuid) || new Promise((resolve) => setTimeout(resolve, POLL_MS)));
  return cards.get(uuid);
}

async function upload(card) {
  await card.upload.run();
  if (card.upload?.complete) uploaded(card);
}

function uploaded(card) {
  card.upload.doneFiles = card.upload.files.length;
  card.upload.doneBytes = card.upload.files.reduce((sum, { file }) => sum + file.size, 0);
  page.check(card);
}

// What the node says.

let polling = 0;
let asked = 0;
let latest = null; // the last request for the state

/** Ask the node for its state, and show it; resolves when that or a later state is shown, or the node does not answer. */
function refresh() {
  asked += 1;
  return (latest = shown(asked));
}

async function shown(mine) {
  try {
    const state = await getJson("api/state");
    if (mine !== asked) return latest;
    by("silent").hidden = true;
    show(state);
  } catch (error) {
    if (!(error instanceof RefusedError)) throw error;
    by("silent").hidden = false;
    by("silent").textContent = error.status === 403 ? "The node was started anew: open its page again." : `${error.message} Trying again; nothing is lost.`;
  }
}

async function poll() {
  clearTimeout(polling);
  await refresh();
  clearTimeout(polling);
  polling = setTimeout(poll, document.hidden ? POLL_HIDDEN_MS : POLL_MS);
}

function show(state) {
  node = state.node;
  page.offered = state.options;
  by("about").textContent = aboutText(node);
  by("place").textContent = node.place ?? "";
  const known = new Set();
  for (const task of state.tasks) {
    known.add(task.uuid);
    const card = cards.get(task.uuid);
    if (!card) cards.set(task.uuid, new JobCard(task, page));
    else {
      if (card.task.state !== task.state) by("said").textContent = `${task.name}: ${task.state}`;
      card.update(task);
    }
  }
  for (const [uuid, card] of cards) {
    if (known.has(uuid)) continue;
    card.root.remove();
    cards.delete(uuid);
  }
  arrange(state.tasks);
  by("more").hidden = !state.more;
  by("more").textContent = state.more ? `${count(state.more, "older job")} not shown.` : "";
  const running = state.tasks.filter((task) => task.state === "running").length;
  document.title = running ? `${running} running · splatpipe` : "splatpipe";
}

/** Put each card into its section, in the node's order, and move only what has to move. */
function arrange(tasks) {
  for (const name of new Set(Object.values(SECTIONS))) {
    const section = by(name);
    const wanted = tasks.filter((task) => SECTIONS[task.state] === name).map((task) => cards.get(task.uuid).root);
    section.hidden = !wanted.length;
    const list = section.querySelector(".jobs");
    wanted.forEach((root, number) => {
      if (list.children[number] === root) return;
      const held = root.contains(document.activeElement) ? document.activeElement : null;
      list.insertBefore(root, list.children[number] ?? null);
      held?.focus({ preventScroll: true });
    });
  }
  by("none").hidden = tasks.length > 0;
}

function aboutText({ free_bytes, keep_days, parallel, running, version }) {
  const kept = keep_days ? `finished jobs are kept ${count(keep_days, "day")}` : "jobs are kept until you remove them";
  const beside = parallel > 1 ? `${parallel} runs at a time` : "one run at a time";
  return `${size(free_bytes)} of disk free · ${beside}, ${running} now · ${kept} · splatpipe ${version}`;
}

// The page itself.

for (const id of ["folder", "files"]) {
  by(id).addEventListener("change", (event) => {
    const into = target;
    const chosen = plainFiles(event.target.files);
    event.target.value = "";
    target = null;
    if (chosen.length) take(chosen, into);
  });
  by(`choose_${id}`).addEventListener("click", () => {
    target = null;
    by(id).click();
  });
}
document.addEventListener("dragover", (event) => {
  if (!event.dataTransfer.types.includes("Files")) return;
  event.preventDefault();
  document.body.classList.add("over");
});
document.addEventListener("dragleave", (event) => {
  if (!event.relatedTarget) document.body.classList.remove("over");
});
document.addEventListener("drop", (event) => {
  if (!event.dataTransfer.types.includes("Files")) return;
  event.preventDefault();
  document.body.classList.remove("over");
  const card = cards.get(event.target.closest?.(".job")?.dataset.uuid);
  const read = (number) => (by("reading").textContent = `Reading the folder: ${count(number, "file")} so far…`);
  take(droppedFiles(event.dataTransfer, read), card?.task.state === "uploading" ? card : null);
});
addEventListener("beforeunload", (event) => {
  if ([...cards.values()].some((card) => card.upload?.running)) event.preventDefault();
});
document.addEventListener("visibilitychange", () => !document.hidden && poll());
const ready = poll();
window.splatpipe = { ready, ended: (name) => [...cards.values()].some((card) => card.task.name === name && ENDED.includes(card.task.state)) };
