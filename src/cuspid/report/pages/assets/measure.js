// Two clicks on a picture measure between two places, and tell how the panorama is scaled by that distance.
"use strict";
(() => {
  const STILL_PX = 4;
  for (const told of document.querySelectorAll("[data-measures]")) {
    const frame = document.querySelector(`.zoomed[data-group="${told.dataset.measures}"]`);
    const image = frame.querySelector("img");
    const widthPx = Number(told.dataset.widthPx);
    const mmPerPx = Number(told.dataset.mmPerPx);
    const marks = document.createElementNS("http://www.w3.org/2000/svg", "svg");
    marks.classList.add("marks");
    frame.append(marks);
    let places = [];
    let pressed = null;

    const shown = () => {
      const picture = image.getBoundingClientRect();
      const around = marks.getBoundingClientRect();
      const scale = picture.width / widthPx;
      return { scale, left: picture.left, top: picture.top, x: picture.left - around.left, y: picture.top - around.top };
    };
    const draw = () => {
      const { scale, x, y } = shown();
      const at = places.map(([u, v]) => [x + u * scale, y + v * scale]);
      const dots = at.map(([cx, cy]) => `<circle cx="${cx}" cy="${cy}" r="5"/>`).join("");
      const line = at.length === 2 ? `<line x1="${at[0][0]}" y1="${at[0][1]}" x2="${at[1][0]}" y2="${at[1][1]}"/>` : "";
      marks.innerHTML = line + dots;
    };
    const follow = () => {
      draw();
      if (image.getAnimations().length) requestAnimationFrame(follow);
    };
    const tell = () => {
      told.querySelector("output").hidden = places.length < 2;
      if (places.length < 2) return;
      const [a, b] = places;
      const px = Math.hypot(a[0] - b[0], a[1] - b[1]);
      told.querySelector("b").textContent = mmPerPx ? `${(px * mmPerPx).toFixed(2)} mm` : `${px.toFixed(0)} px`;
      const pixels = told.querySelector(".pixels");
      if (pixels) pixels.textContent = [...a, ...b].map((each) => each.toFixed(0)).join(" ");
    };
    const mark = (event) => {
      const { scale, left, top } = shown();
      const place = [(event.clientX - left) / scale, (event.clientY - top) / scale];
      const heightPx = (widthPx * image.naturalHeight) / image.naturalWidth;
      if (place[0] < 0 || place[1] < 0 || place[0] >= widthPx || place[1] >= heightPx) return;
      places = places.length === 1 ? [...places, place] : [place];
      draw();
      tell();
    };

    // The picture's own handlers, which move it, let no pointerdown through.
    frame.addEventListener("pointerdown", (event) => (pressed = event.isPrimary && event.button === 0 ? event : null), true);
    frame.addEventListener("pointerup", (event) => {
      const moved = pressed && Math.hypot(event.clientX - pressed.clientX, event.clientY - pressed.clientY);
      if (pressed && moved < STILL_PX && event.detail < 2) mark(event);
      pressed = null;
    });
    frame.addEventListener("dblclick", () => {
      places = [];
      draw();
      tell();
    });
    image.addEventListener("panzoomchange", follow);
    new ResizeObserver(draw).observe(image);
  }
})();
