// Pictures and videos that people take home: app.picture (main.js) draws them, here they become files.

const VIDEO_TYPES = ["video/webm;codecs=vp9", "video/webm", "video/mp4"];  // the first that the browser writes
const VIDEO_FPS = 30;
const VIDEO_BITS = 12e6;     // a second; the browsers' own choice is blurred
const KEEP_LINK_MS = 10000;  // until the browser has begun to save

function saveFile(blob, name) {
  const link = Object.assign(document.createElement("a"), { href: URL.createObjectURL(blob), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), KEEP_LINK_MS);
}

function makeSaving(app, canvas) {
  const name = document.title;

  async function saveImage() {
    const scale = Number(element("image-scale").value), transparent = element("image-transparent").checked;
    const { blob, width, height } = await app.picture(scale, transparent);
    if (!blob) {
      say(`a picture of ${width} × ${height} pixels is more than this browser makes: choose a smaller one`, true);
      return;
    }
    saveFile(blob, `${name}.png`);
    say(`${name}.png: ${width} × ${height} pixels`);
  }

  // ---- videos ----
  let recorder = null, clock = 0;

  function record() {
    const type = VIDEO_TYPES.find((each) => MediaRecorder.isTypeSupported(each));
    app.setRecording(true);
    const chunks = [], began = performance.now();
    recorder = new MediaRecorder(canvas.captureStream(VIDEO_FPS), { mimeType: type, videoBitsPerSecond: VIDEO_BITS });
    recorder.ondataavailable = (event) => { chunks.push(event.data); };
    recorder.onerror = (event) => say(`the browser stopped the video: ${event.error?.message ?? "no reason given"}`, true);
    recorder.onstop = () => {
      const ending = recorder.mimeType.includes("mp4") ? "mp4" : "webm";
      endRecording();
      const video = new Blob(chunks, { type });
      if (!video.size) return;
      saveFile(video, `${name}.${ending}`);
      say(`${name}.${ending}: ${((performance.now() - began) / 1000).toFixed(0)} s`);
    };
    recorder.start();
    const tell = () => { element("recorded").textContent = `${((performance.now() - began) / 1000).toFixed(0)} s`; };
    tell();
    clock = setInterval(tell, 1000);
  }

  function endRecording() {
    clearInterval(clock);
    for (const track of recorder.stream.getTracks()) track.stop();
    recorder = null;
    app.setRecording(false);
  }

  function startVideo() {
    try {
      record();
    } catch (error) {
      app.setRecording(false);
      say(`the browser makes no video: ${error.message}`, true);
    }
  }

  element("save-image").onclick = saveImage;
  const able = typeof MediaRecorder !== "undefined" && typeof canvas.captureStream === "function";
  element("record-video").hidden = !able || !VIDEO_TYPES.some((type) => MediaRecorder.isTypeSupported(type));
  element("record-video").onclick = startVideo;
  element("stop-video").onclick = () => recorder?.stop();
}
