// Search of the site without a server. Browsers start no worker from file://, so a hidden frame runs its script.
// Messages arrive later, and as copies, as those of a worker do.
if (location.protocol === "file:") {
  const send = (target, data) => setTimeout(() => {
    const event = new MessageEvent("message", { data: structuredClone(data) });
    target.dispatchEvent(event);
    if (target instanceof Worker) target.onmessage?.(event);
  });
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      const frame = document.body.appendChild(Object.assign(document.createElement("iframe"), { hidden: true }));
      const inside = frame.contentWindow;
      inside.postMessage = (data) => send(this, data);
      const script = Object.assign(inside.document.createElement("script"), { src: url });
      const loaded = new Promise((done) => { script.onload = done; });
      this.postMessage = (data) => loaded.then(() => send(inside, data));
      inside.document.body.append(script);
    }
    terminate() {}
  };
}
