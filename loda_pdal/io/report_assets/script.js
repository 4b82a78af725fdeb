"use strict";
// Sort a table by the clicked column: numbers by value, text by the alphabet, unknown always last.
document.querySelectorAll("table.changes").forEach(function (table) {
  table.querySelectorAll("th").forEach(function (head, column) {
    function sort() {
      const up = head.getAttribute("aria-sort") === "descending" || !head.hasAttribute("aria-sort") && !head.classList.contains("n");
      table.querySelectorAll("th").forEach(function (other) { other.removeAttribute("aria-sort"); });
      head.setAttribute("aria-sort", up ? "ascending" : "descending");
      const body = table.tBodies[0];
      const rows = Array.from(body.rows).map(function (row) {
        const text = row.cells[column].dataset.v;
        return { row: row, text: text, number: head.classList.contains("n") ? parseFloat(text) : NaN };
      });
      rows.sort(function (a, b) {
        if (a.text === "" || b.text === "") { return (a.text === "") - (b.text === ""); }
        const order = isNaN(a.number) || isNaN(b.number) ? a.text.localeCompare(b.text) : a.number - b.number;
        return up ? order : -order;
      });
      rows.forEach(function (entry) { body.appendChild(entry.row); });
    }
    head.tabIndex = 0;
    head.addEventListener("click", sort);
    head.addEventListener("keydown", function (event) { if (event.key === "Enter") { sort(); } });
  });
});
// The legend shows and hides map shapes, table rows and cards of one label.
document.querySelectorAll(".legend input").forEach(function (box) {
  function apply() {
    document.querySelectorAll("[data-label='" + box.value + "']").forEach(function (part) {
      part.classList.toggle("off", !box.checked);
    });
  }
  box.addEventListener("change", apply);
  apply();
});
