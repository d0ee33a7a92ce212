// What the page says of its loading: a bar, a message in the middle of the page, a note at its edge.

const $ = (id) => document.getElementById(id);

export function progress(share) {
  $("bar").classList.add("known");
  $("bar").style.width = `${Math.round(100 * share)}%`;
}

/** A message in the middle of the page: there is nothing else to see. */
export function tell(message, hint, choose = false) {
  $("loading").hidden = false;
  $("loading").classList.add("failed");
  $("message").textContent = message;
  $("advice").textContent = hint;
  $("choose").hidden = !choose;
}

/** The model is there. */
export function loaded() {
  document.body.classList.add("ready");
  $("loading").hidden = true;
}

/** A sentence at the page's edge: what is there can be seen. */
export function note(text) {
  $("notice").textContent = text;
  $("notice").hidden = false;
}

/**
 * A splat that is dropped on the page or chosen, where the page cannot read it itself.
 * @param {(bytes: Uint8Array) => Promise<void>} show
 */
export function acceptFile(show) {
  const take = async (file) => {
    if (!file) return;
    $("loading").classList.remove("failed");
    $("message").textContent = "Reading…";
    $("advice").textContent = "";
    try {
      await show(new Uint8Array(await file.arrayBuffer()));
    } catch (error) {
      tell(error.message, error.hint ?? "", true);
    }
  };
  $("file").addEventListener("change", (event) => take(event.target.files[0]));
  addEventListener("dragover", (event) => event.preventDefault());
  addEventListener("drop", (event) => {
    event.preventDefault();
    take(event.dataTransfer.files[0]);
  });
}
