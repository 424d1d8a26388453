// Unpacks the arrays and the viewer script in report.html.
const unpacked = (id) => {
  const bytes = Uint8Array.from(atob(document.getElementById(id).textContent), (c) => c.charCodeAt(0));
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream('gzip')));
};
unpacked('viewer').text().then((text) => {
  const script = document.createElement('script');
  script.textContent = text;
  document.body.append(script);
});
