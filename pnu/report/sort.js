// Tables: a click on a head sorts, a second one turns the order round.
for (const table of document.querySelectorAll("table.sortable")) {
  table.tHead.rows[table.tHead.rows.length - 1].querySelectorAll("th").forEach((head, column) => {
    head.tabIndex = 0;
    const sort = () => {
      const down = head.getAttribute("aria-sort") === "ascending";
      table.querySelectorAll("th").forEach((other) => other.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", down ? "descending" : "ascending");
      const value = (row) => { const v = row.cells[column].dataset.value; return v === undefined ? row.cells[column].textContent : v === "" ? Infinity : Number(v); };
      const order = (a, b) => { const [x, y] = [value(a), value(b)]; return (typeof x === "string" ? x.localeCompare(y) : x === y ? 0 : x - y) * (down ? -1 : 1); };
      table.tBodies[0].append(...[...table.tBodies[0].rows].sort(order));
    };
    head.onclick = sort;
    head.onkeydown = (event) => { if (event.key === "Enter") sort(); };
  });
}
