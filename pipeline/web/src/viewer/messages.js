// Loading status of the page: a bar, a message in the middle of the page, a note at its edge.

const $ = (id) => document.getElementById(id);

export function progress(share) {
  $("bar").classList.add("known");
  $("bar").style.width = `${Math.round(100 * share)}%`;
}

/** Show a message in the middle of the page, while there is nothing else to see. */
export function showMessage(message, hint, choose = false) {
  $("loading").hidden = false;
  $("loading").classList.add("failed");
  $("message").textContent = message;
  $("advice").textContent = hint;
  $("choose").hidden = !choose;
}

/** Hide the loading status: the model is shown. */
export function loaded() {
  document.body.classList.add("ready");
  $("loading").hidden = true;
}

/** Show a sentence at the page's edge, without hiding the model. */
export function note(text) {
  $("notice").textContent = text;
  $("notice").hidden = false;
}

/**
 * Accept a splat file dropped on the page or chosen, if the page cannot load it itself.
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
      showMessage(error.message, error.hint ?? "", true);
    }
  };
  $("file").addEventListener("change", (event) => take(event.target.files[0]));
  addEventListener("dragover", (event) => event.preventDefault());
  addEventListener("drop", (event) => {
    event.preventDefault();
    take(event.dataTransfer.files[0]);
  });
}
