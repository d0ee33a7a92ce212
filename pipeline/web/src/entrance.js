// Exchanges the node's token for a cookie, and goes on to the page.

import { RefusedError, postJson } from "./node/server.js";

const form = document.getElementById("entrance");
const refused = document.getElementById("refused");

form.addEventListener("submit", async (event) => {
  event.preventDefault();
  const token = document.getElementById("token");
  refused.hidden = true;
  try {
    const { to } = await postJson("page/enter", { token: token.value });
    location.replace(to);
  } catch (error) {
    if (!(error instanceof RefusedError)) throw error;
    refused.textContent = error.message;
    refused.hidden = false;
    token.select();
  }
});
