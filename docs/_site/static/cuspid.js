// Tables, formulas and code that are wider than the page are moved by the keys; headings of the contents have their level;
// the two sidebars have names of their own and are opened by the keys, and a table's empty corner is no heading.
"use strict";
addEventListener("DOMContentLoaded", () => {
  for (const caption of document.querySelectorAll(".caption[role=heading]")) caption.ariaLevel = "2";
  for (const [place, name] of [[".sidebar-drawer", "All pages"], [".toc-drawer", "This page"]]) {
    document.querySelector(place)?.setAttribute("aria-label", name);
  }
  for (const label of document.querySelectorAll(".nav-overlay-icon, .toc-overlay-icon")) {
    const box = document.getElementById(label.htmlFor);
    const button = Object.assign(document.createElement("button"), {
      className: label.className, ariaLabel: box.ariaLabel, ariaExpanded: box.checked, onclick: () => box.click(),
    });
    button.append(...label.childNodes);
    label.replaceWith(button);
    box.addEventListener("change", () => { button.ariaExpanded = box.checked; });
    addEventListener("keydown", (event) => { if (event.key === "Escape" && box.checked) box.click(); });
  }
  for (const cell of document.querySelectorAll("th")) {
    if (!cell.textContent.trim()) cell.replaceWith(document.createElement("td"));
  }
  const watch = new ResizeObserver((entries) => {
    for (const { target } of entries) {
      if (target.scrollWidth > target.clientWidth) target.tabIndex = 0;
      else target.removeAttribute("tabindex");
    }
  });
  for (const each of document.querySelectorAll(".table-wrapper, .formula, .highlight pre")) watch.observe(each);
});
