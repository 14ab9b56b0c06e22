// A menu for each column that may be filtered; without scripts the whole table is there.
{
  const place = document.getElementById("measurements")
  const rows = [...place.querySelectorAll("tbody tr")]
  const heads = [...place.querySelectorAll("th")].map((cell) => cell.textContent)
  const text = (row, column) => row.cells[column].textContent
  const menus = new Map()
  const bar = document.createElement("p")
  const show = () => {
    for (const row of rows) {
      row.hidden = ![...menus].every(([column, menu]) => !menu.value || menu.value === text(row, column))
    }
  }
  for (const column of place.dataset.filters.split(" ").map(Number)) {
    const values = [...new Set(rows.map((row) => text(row, column)))]
    values.sort((a, b) => a.localeCompare(b, "en", { numeric: true }))
    const menu = document.createElement("select")
    menu.append(new Option("all", ""), ...values.map((value) => new Option(value)))
    menu.addEventListener("change", show)
    const label = document.createElement("label")
    label.append(`${heads[column]} `, menu, " ")
    bar.append(label)
    menus.set(column, menu)
  }
  place.prepend(bar)
}
