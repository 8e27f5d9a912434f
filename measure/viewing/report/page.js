// Drawn once the page is laid out: a figure takes the width of its place, which is not known before.
const packed = document.getElementById("plotly").textContent;
const bytes = Uint8Array.from(atob(packed), (letter) => letter.charCodeAt(0));
const unpacked = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
new Response(unpacked).text().then((code) => {
  const library = document.createElement("script");
  library.textContent = code;
  document.head.append(library);
  document.querySelectorAll("script.spec").forEach((spec) => {
    const figure = JSON.parse(spec.textContent);
    Plotly.newPlot(spec.dataset.for, figure.data, figure.layout,
      {responsive: true, displaylogo: false, displayModeBar: false});
  });
});
