// A batch's page while the batch is running: shows its age, reloads itself, and warns if it is no longer updated.
// Without scripts, the browser's own refresh reloads it.

const body = document.body;
const written = Number(body.dataset.written) * 1000; // milliseconds
const silence = Number(body.dataset.silence) * 1000; // longest time without an update
const every = Number(body.dataset.refresh) * 1000;
const opened = Date.now();
const age = document.querySelector("[data-age]");
const silent = document.querySelector("[data-silent]");
const pause = document.querySelector("[data-pause]");
let paused = false;
let leaving = false;

/** A duration in words, to the second or the minute. */
function words(milliseconds) {
  const seconds = Math.round(milliseconds / 1000);
  if (seconds < 60) return `${seconds} s`;
  const minutes = Math.floor(seconds / 60);
  return minutes < 60 ? `${minutes} min` : `${Math.floor(minutes / 60)} h ${minutes % 60} min`;
}

/** Whether reloading would lose the reader's text selection or keyboard focus. */
function busy() {
  return document.querySelector("main :focus-visible") !== null || !document.getSelection().isCollapsed;
}

function tick() {
  const old = Date.now() - written;
  if (old >= 0) age.textContent = ` (${words(old)} ago)`; // the reader's clock may differ
  silent.hidden = old < silence;
  if (paused || leaving || busy() || document.hidden || Date.now() - opened < every) return;
  leaving = true;
  location.reload();
}

pause.hidden = false;
pause.addEventListener("click", () => {
  paused = !paused;
  pause.textContent = paused ? "Resume refreshing" : "Pause";
  pause.setAttribute("aria-pressed", String(paused));
});
tick();
setInterval(tick, 1000);
