// What the page does in the browser beyond showing: keys on charts, a sound, a picture of all charts.
document.documentElement.lang = "en";
window.magbridge = {
  map: "",

  number(value, digits) {
    if (Math.abs(value) >= 1e9) return value.toExponential(2);
    return value.toLocaleString("en", { maximumFractionDigits: digits }).replaceAll(",", "\u202f");
  },

  // what a curve shows at the pointer: made of numbers alone, so that no name that somebody sent gets into the HTML
  tip: (digits, unit) => (seen) => {
    const number = (value) => `${magbridge.number(value, digits)} ${unit}`.trim();
    const mean = seen.find((one) => one.seriesName === "mean" && one.value[1] !== null);
    const mark = seen.find((one) => one.seriesName === "beyond");
    const time = new Date(seen[0].value[0]).toISOString().slice(0, 19).replace("T", " ") + " UTC";
    return [time, mean && number(mean.value[1]),
      mean && mean.value[2] > 0 && `${magbridge.number(mean.value[3], digits)} to ${magbridge.number(mean.value[4], digits)} with 2σ`,
      mark && "beyond the axis: " + number(mark.value[2])].filter(Boolean).join("<br>");
  },

  // latitude and longitude of a point of the track
  place: (one) => one.value.slice(0, 2).reverse().map((value) => value.toFixed(5)).join(", "),

  degrees: (value) => value.toFixed(4) + "°",

  // the anomaly grid beneath the track
  picture(params, api) {
    const a = api.coord([api.value(0), api.value(3)]), b = api.coord([api.value(2), api.value(1)]);
    const style = { image: magbridge.map, x: a[0], y: a[1], width: b[0] - a[0], height: b[1] - a[1], opacity: 0.75 };
    return { type: "image", silent: true, style };
  },

  chart(element) {
    const drawn = element.querySelector(".nicegui-echart") ?? element;
    return getElement(drawn.id.slice(1))?.chart;
  },

  // plus, minus and the arrows zoom and pan a chart that has the focus; 0 shows all, S saves it
  key(event) {
    const chart = event.target.dataset?.chart !== undefined && magbridge.chart(event.target);
    if (!chart || event.ctrlKey || event.metaKey || event.altKey) return;
    const { start, end } = chart.getOption().dataZoom[0];
    const span = end - start;
    const ends = {
      "+": [start + span / 4, end - span / 4],
      "-": [start - span / 2, end + span / 2],
      ArrowLeft: [start - span / 4, end - span / 4],
      ArrowRight: [start + span / 4, end + span / 4],
      0: [0, 100],
    }[event.key];
    if (event.key.toLowerCase() === "s") magbridge.save(chart.getDataURL({ pixelRatio: 2 }), "magbridge_chart.png");
    if (!ends) return;
    event.preventDefault();
    const width = Math.min(ends[1] - ends[0], 100);
    const from = Math.max(0, Math.min(ends[0], 100 - width));
    chart.getOption().dataZoom.forEach((_, dataZoomIndex) =>
      chart.dispatchAction({ type: "dataZoom", dataZoomIndex, start: from, end: from + width }));
  },

  // two short tones; silent until the reader has switched the sound on, which browsers require
  beep() {
    const audio = (magbridge.audio ??= new AudioContext());
    audio.resume();
    [880, 660].forEach((pitch, k) => {
      const tone = audio.createOscillator(), volume = audio.createGain();
      tone.frequency.value = pitch;
      volume.gain.value = 0.15;
      tone.connect(volume).connect(audio.destination);
      tone.start(audio.currentTime + 0.25 * k);
      tone.stop(audio.currentTime + 0.25 * k + 0.2);
    });
  },

  save(url, name) {
    const link = document.createElement("a");
    link.href = url;
    link.download = name;
    link.click();
  },

  // one PNG: the lines of text, and below them every chart that is shown
  async snapshot(lines, name) {
    const dark = document.body.classList.contains("body--dark");
    const [paper, ink] = dark ? ["#1e293b", "#e2e8f0"] : ["#ffffff", "#1e293b"];
    const shown = [...document.querySelectorAll("[data-chart]")].filter((one) => one.offsetParent);
    const pictures = await Promise.all(shown.map(async (element) => {
      const picture = new Image();
      picture.src = magbridge.chart(element).getDataURL({ pixelRatio: 2, backgroundColor: paper, excludeComponents: ["toolbox"] });
      await picture.decode();
      return { picture, title: element.getAttribute("aria-label").split(";")[0] };
    }));
    const width = Math.max(1200, ...pictures.map((one) => one.picture.width + 80));
    const height = 60 + 40 * lines.length + pictures.reduce((sum, one) => sum + one.picture.height + 70, 0);
    const canvas = Object.assign(document.createElement("canvas"), { width, height });
    const pen = canvas.getContext("2d");
    pen.fillStyle = paper;
    pen.fillRect(0, 0, width, height);
    pen.fillStyle = ink;
    let y = 50;
    lines.forEach((line, k) => {
      pen.font = (k ? "" : "bold ") + "26px sans-serif";
      pen.fillText(line, 40, y, width - 80);
      y += 40;
    });
    for (const { picture, title } of pictures) {
      pen.font = "bold 24px sans-serif";
      pen.fillText(title, 40, y + 30);
      pen.drawImage(picture, 40, y + 50);
      y += picture.height + 70;
    }
    const blob = await new Promise((resolve) => canvas.toBlob(resolve, "image/png"));
    const url = URL.createObjectURL(blob);
    magbridge.save(url, name);
    setTimeout(() => URL.revokeObjectURL(url), 10000);
  },
};
document.addEventListener("keydown", window.magbridge.key);
