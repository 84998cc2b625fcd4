// Pictures to zoom and move; those of one group move together. The work is panzoom's.
"use strict";
(() => {
  const groups = new Map();
  for (const frame of document.querySelectorAll(".zoomed")) {
    const image = frame.querySelector("img");
    const fit = () => {
      const scale = Math.min(frame.clientWidth / image.naturalWidth, frame.clientHeight / image.naturalHeight);
      image.style.width = `${image.naturalWidth * scale}px`;
      image.style.left = `${(frame.clientWidth - image.naturalWidth * scale) / 2}px`;
      image.style.top = `${(frame.clientHeight - image.naturalHeight * scale) / 2}px`;
    };
    image.decode().then(fit, fit);
    new ResizeObserver(fit).observe(frame);
    const zoom = Panzoom(image, { maxScale: 20, minScale: 1, canvas: true, step: 0.35, animate: false });
    const group = groups.get(frame.dataset.group) ?? [];
    groups.set(frame.dataset.group, [...group, zoom]);
    frame.addEventListener("wheel", (event) => zoom.zoomWithWheel(event));
    frame.addEventListener("dblclick", () => zoom.reset({ animate: false }));
    image.addEventListener("panzoomchange", ({ detail }) => {
      for (const other of groups.get(frame.dataset.group)) {
        if (other === zoom || !detail.originalEvent) continue;
        other.zoom(detail.scale);
        other.pan(detail.x, detail.y);
      }
    });
  }
  const STEP_PX = 40;
  const keys = {
    ArrowLeft: (zoom) => zoom.pan(STEP_PX / zoom.getScale(), 0, { relative: true }),
    ArrowRight: (zoom) => zoom.pan(-STEP_PX / zoom.getScale(), 0, { relative: true }),
    ArrowUp: (zoom) => zoom.pan(0, STEP_PX / zoom.getScale(), { relative: true }),
    ArrowDown: (zoom) => zoom.pan(0, -STEP_PX / zoom.getScale(), { relative: true }),
    "+": (zoom) => zoom.zoomIn(),
    "-": (zoom) => zoom.zoomOut(),
    0: (zoom) => zoom.reset({ animate: false }),
  };
  for (const frame of document.querySelectorAll(".zoomed")) {
    frame.addEventListener("keydown", (event) => {
      const act = keys[event.key];
      if (!act || event.ctrlKey || event.metaKey || event.altKey) return;
      event.preventDefault();
      groups.get(frame.dataset.group).forEach(act);
    });
  }
  for (const button of document.querySelectorAll("[data-zoom]")) {
    button.addEventListener("click", () => {
      for (const each of groups.get(button.dataset.group)) {
        if (button.dataset.zoom === "in") each.zoomIn();
        else if (button.dataset.zoom === "out") each.zoomOut();
        else each.reset({ animate: false });
      }
    });
  }
})();
