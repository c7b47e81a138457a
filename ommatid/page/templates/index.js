"use strict";
// Sorts a table by the column whose heading is clicked: numbers by value, texts by alphabet, rows without a value last.
for (const table of document.querySelectorAll("table.sortable")) {
  const body = table.tBodies[0];
  const headings = [...table.tHead.rows[0].cells];
  const valueOf = (row, column) => {
    const cell = row.cells[column];
    const text = cell?.dataset.value ?? cell?.textContent.trim() ?? "";
    return text !== "" && Number.isFinite(Number(text)) ? Number(text) : text;
  };
  const compare = (one, other) => (typeof one === "number" && typeof other === "number"
    ? one - other : String(one).localeCompare(String(other), undefined, { numeric: true }));
  const sort = (column, sign) => {
    const pairs = [...body.rows].map((row) => [valueOf(row, column), row]);
    pairs.sort(([one], [other]) => (one === "" || other === "" ? (one === "") - (other === "") : sign * compare(one, other)));
    body.append(...pairs.map(([, row]) => row));
  };
  for (const [column, heading] of headings.entries()) {
    if (heading.dataset.sort === undefined) continue;
    const button = Object.assign(document.createElement("button"), { type: "button", className: "sort" });
    button.append(...heading.childNodes);
    heading.append(button);
    button.addEventListener("click", () => {
      const sign = heading.ariaSort === "ascending" ? -1 : 1;
      for (const other of headings) other.removeAttribute("aria-sort");
      heading.setAttribute("aria-sort", sign > 0 ? "ascending" : "descending");
      sort(column, sign);
    });
  }
}
document.documentElement.dataset.ready = "yes";
