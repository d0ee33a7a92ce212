// Loads a site's viewer, compressed: a third of the bytes if the host does not compress. It then requests the first
// part of the splat, which arrives while the browser parses the viewer. site.py writes the addresses.

const { script, packed, first } = document.currentScript.dataset;
const GZIP = [0x1f, 0x8b];

/** URL of the unpacked viewer. */
async function unpack() {
  const answer = await fetch(packed);
  if (!answer.ok) throw new Error(`${answer.status}`);
  const bytes = new Uint8Array(await answer.arrayBuffer());
  const hint = Object.assign(document.createElement("link"), { rel: "preload", as: "fetch", crossOrigin: "", href: first });
  document.head.append(hint);
  let stream = new Blob([bytes]).stream();
  if (GZIP.every((byte, i) => bytes[i] === byte)) stream = stream.pipeThrough(new DecompressionStream("gzip")); // some hosts have the browser unpack it
  const text = await new Response(stream).arrayBuffer();
  return URL.createObjectURL(new Blob([text], { type: "text/javascript" }));
}

function run(src) {
  return new Promise((resolve, reject) => {
    const element = Object.assign(document.createElement("script"), { src, onload: resolve, onerror: reject });
    document.head.append(element);
  });
}

const ready = unpack()
  .catch(() => script) // an old browser, or a page opened from disk
  .then(run)
  .catch(() => {
    document.getElementById("message").textContent = "The viewer cannot be loaded.";
    document.getElementById("advice").textContent = "Reload this page, and check that the host has the complete folder.";
    throw new Error("the viewer cannot be loaded");
  })
  .then(() => window.splatpipe.ready); // the viewer's own, see viewer.js
ready.catch(() => null); // the page reports it
window.splatpipe = { ready };
