// A batch's page while the batch runs: says how old it is, loads itself again, and tells when nobody writes it any more.
// Without scripts a refresh of the browser's own does the loading.

const body = document.body;
const written = Number(body.dataset.written) * 1000; // milliseconds
const silence = Number(body.dataset.silence) * 1000; // so long without a word is too long
const every = Number(body.dataset.refresh) * 1000;
const opened = Date.now();
const age = document.querySelector("[data-age]");
const silent = document.querySelector("[data-silent]");
const pause = document.querySelector("[data-pause]");
let paused = false;
let leaving = false;

/** A time in words, to the second or the minute. */
function words(milliseconds) {
  const seconds = Math.round(milliseconds / 1000);
  if (seconds < 60) return `${seconds} s`;
  const minutes = Math.floor(seconds / 60);
  return minutes < 60 ? `${minutes} min` : `${Math.floor(minutes / 60)} h ${minutes % 60} min`;
}

/** Whether loading again would take something away: a reader's selection, or the place of the keyboard. */
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
