// Tables, formulas and code that are wider than the page are moved by the keys; headings of the contents have their level.
"use strict";
addEventListener("DOMContentLoaded", () => {
  for (const caption of document.querySelectorAll(".caption[role=heading]")) caption.ariaLevel = "2";
  const watch = new ResizeObserver((entries) => {
    for (const { target } of entries) {
      if (target.scrollWidth > target.clientWidth) target.tabIndex = 0;
      else target.removeAttribute("tabindex");
    }
  });
  for (const each of document.querySelectorAll(".table-wrapper, .formula, .highlight pre")) watch.observe(each);
});
