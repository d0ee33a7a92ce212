// The page's requests to the node.

/** An answer that says no; `status` 0 is a node that does not answer. */
export class RefusedError extends Error {
  constructor(status, text, noRetry = false) {
    super(text);
    this.status = status;
    this.noRetry = noRetry;
  }
}

export async function getJson(path) {
  return answered(await reached(path, {}));
}

export async function postJson(path, body) {
  const headers = { "content-type": "application/json" };
  return answered(await reached(path, { method: "POST", headers, body: JSON.stringify(body ?? {}) }));
}

async function reached(path, how) {
  try {
    return await fetch(path, how);
  } catch {
    throw new RefusedError(0, "The node does not answer.");
  }
}

async function answered(answer) {
  const text = (await answer.text()).trim();
  const found = parsed(text);
  if (answer.ok && found && !found.error) return found;
  throw new RefusedError(answer.status, reasonOf(found, text, answer.status), found?.noRetry === true);
}

function parsed(text) {
  try {
    return JSON.parse(text);
  } catch {
    return null;
  }
}

function reasonOf(found, text, status) {
  if (found?.error) return readable(found.error);
  if (found?.message) return `${found.message} ${found.hint ?? ""}`.trim();
  return text && text.length < 300 ? text : `The node answered ${status}.`;
}

/** An error about options is a JSON text of name and error each. */
function readable(error) {
  const list = parsed(error);
  return Array.isArray(list) ? list.map((each) => `${each.name}: ${each.error}`).join(" ") : error;
}

/**
 * Send one file; `onProgress` is told its bytes.
 *
 * By XMLHttpRequest: fetch does not tell how much of a body was sent. Returns the request, to abort it, and its end.
 */
export function sendFile(path, file, onProgress) {
  const request = new XMLHttpRequest();
  const end = new Promise((resolve, reject) => {
    request.upload.onprogress = (event) => onProgress(event.loaded);
    request.onload = () => {
      const found = parsed(request.responseText);
      if (request.status === 200 && found && !found.error) resolve(found);
      else reject(new RefusedError(request.status, reasonOf(found, request.responseText.trim(), request.status), found?.noRetry === true));
    };
    request.onerror = () => reject(new RefusedError(0, "The node does not answer."));
    request.onabort = () => reject(new RefusedError(-1, "Stopped."));
  });
  request.open("POST", path);
  request.setRequestHeader("content-type", "application/octet-stream");
  request.send(file);
  return { request, end };
}
