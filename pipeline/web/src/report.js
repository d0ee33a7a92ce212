// The held-out photos of a report: photo and render become one image with a slider between them.
// Without scripts, and in print, they are side by side.

/** Turns one view's images into a comparison. */
function compare(view) {
  const pictures = view.querySelector(".pictures");
  const photo = pictures.querySelector(".photo");
  const slider = document.createElement("input");
  slider.type = "range";
  slider.min = "0";
  slider.max = "100";
  slider.value = "50";
  slider.step = "0.5";
  slider.setAttribute("aria-label", "photo to the left, render to the right");
  const cut = (percent) => {
    slider.value = String(percent);
    pictures.style.setProperty("--cut", `${slider.value}%`);
  };
  slider.addEventListener("input", () => cut(slider.value));
  const drag = (event) => {
    if (event.type === "pointermove" && event.buttons === 0) return;
    const box = photo.getBoundingClientRect();
    cut(Math.min(100, Math.max(0, ((event.clientX - box.left) / box.width) * 100)));
  };
  for (const figure of [photo, pictures.querySelector(".render")]) {
    figure.addEventListener("pointerdown", drag);
    figure.addEventListener("pointermove", drag);
    figure.addEventListener("dragstart", (event) => event.preventDefault());
  }
  view.classList.add("sliding");
  pictures.append(slider);
  cut(50);
}

document.querySelectorAll("[data-view]").forEach(compare);
