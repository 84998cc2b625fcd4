// What every page does: settings are open on paper, tables are sorted by a press on a column's head, and what is wider or
// taller than its place is moved by the keys, too.
"use strict";
(() => {
  addEventListener("beforeprint", () => {
    for (const each of document.querySelectorAll("details:not([open])")) {
      each.open = true;
      each.dataset.opened = "";
    }
  });
  addEventListener("afterprint", () => {
    for (const each of document.querySelectorAll("details[data-opened]")) {
      each.open = false;
      delete each.dataset.opened;
    }
  });

  const value = (row, column) => {
    const text = row.cells[column].textContent.trim();
    return text === "" || Number.isNaN(Number(text)) ? text : Number(text);
  };
  const before = (a, b) => (typeof a === typeof b ? (a < b ? -1 : a > b ? 1 : 0) : typeof a === "number" ? -1 : 1);
  for (const table of document.querySelectorAll("table.sorted")) {
    [...table.tHead.rows[0].cells].forEach((head, column) => {
      const button = document.createElement("button");
      button.type = "button";
      button.append(...head.childNodes);
      head.append(button);
      button.addEventListener("click", () => {
        const sign = head.ariaSort === "ascending" ? -1 : 1;
        for (const each of table.tHead.rows[0].cells) each.ariaSort = "none";
        head.ariaSort = sign > 0 ? "ascending" : "descending";
        const rows = [...table.tBodies[0].rows];
        table.tBodies[0].append(...rows.sort((a, b) => sign * before(value(a, column), value(b, column))));
      });
    });
  }

  const watch = new ResizeObserver((entries) => {
    for (const { target: { parentElement: box } } of entries) {
      const moves = box.scrollWidth > box.clientWidth || box.scrollHeight > box.clientHeight;
      box.toggleAttribute("tabindex", moves);
      if (moves) box.tabIndex = 0;
    }
  });
  for (const box of document.querySelectorAll(".scroll")) {
    box.role = "group";
    box.ariaLabel = box.closest("section").querySelector("h2")?.textContent ?? "Table";
    watch.observe(box.firstElementChild);
  }
})();
