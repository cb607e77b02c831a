// Saves pictures and videos: app.picture (main.js) draws them, and here they become files.

const VIDEO_TYPES = ["video/webm;codecs=vp9", "video/webm", "video/mp4"];  // the first that the browser writes
const VIDEO_FPS = 30;
const VIDEO_BITS = 12e6;     // a second; the browsers' own choice is blurred
const KEEP_LINK_MS = 10000;  // until the browser has begun to save

const PICTURE_MARK = "Software\0humangs_jax";  // as io/images.py marks pictures that are no photos
const PNG_HEAD = 33;         // bytes of a PNG up to the end of its first chunk, the sizes

// Returns the checksum of a chunk of a PNG (CRC-32, ISO 3309).
function crc32(bytes) {
  let crc = 0xffffffff;
  for (const byte of bytes) {
    crc ^= byte;
    for (let i = 0; i < 8; i++) crc = (crc >>> 1) ^ (crc & 1 ? 0xedb88320 : 0);
  }
  return (crc ^ 0xffffffff) >>> 0;
}

// Returns the PNG with a text that marks it as a drawing, so that humangs does not take it for a
// photo.
async function marked(blob) {
  const png = new Uint8Array(await blob.arrayBuffer());
  const text = new TextEncoder().encode(`tEXt${PICTURE_MARK}`), chunk = new Uint8Array(text.length + 8);
  const numbers = new DataView(chunk.buffer);
  numbers.setUint32(0, text.length - 4);
  chunk.set(text, 4);
  numbers.setUint32(text.length + 4, crc32(text));
  return new Blob([png.subarray(0, PNG_HEAD), chunk, png.subarray(PNG_HEAD)], { type: "image/png" });
}

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
    saveFile(await marked(blob), `${name}.png`);
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
