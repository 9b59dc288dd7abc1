// Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
// The connection to the monitor: a WebSocket that comes back by itself.

const FIRST = 500; // ms before the first attempt to come back, doubled up to LAST
const LAST = 4000;
const JSON_START = 4;
// From the address that the monitor prints: without it the page may only look.
const TOKEN = new URLSearchParams(location.search).get("token") ?? "";

export class Link {
  constructor(take, tell) {
    this.take = take; // called with (header, numbers) of every message
    this.tell = tell; // called with true and false as the connection comes and goes
    this.wait = FIRST;
    // A page that nobody looks at costs the loop nothing.
    document.addEventListener("visibilitychange", () => this.look());
    this.look();
  }

  look() {
    if (document.hidden) {
      clearTimeout(this.timer);
      this.socket?.close();
    } else if (!this.socket) {
      this.open();
    }
  }

  open() {
    clearTimeout(this.timer);
    const socket = new WebSocket(`ws://${location.host}/ws`);
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    socket.onopen = () => {
      this.wait = FIRST;
      this.tell(true);
    };
    socket.onmessage = (event) => this.read(event.data);
    socket.onclose = () => {
      this.socket = null;
      if (document.hidden) return;
      this.tell(false);
      this.timer = setTimeout(() => this.look(), this.wait);
      this.wait = Math.min(2 * this.wait, LAST);
    };
  }

  read(data) {
    if (typeof data === "string") {
      this.take(JSON.parse(data), null);
      return;
    }
    const length = new DataView(data).getUint32(0, true);
    const header = JSON.parse(new TextDecoder().decode(new Uint8Array(data, JSON_START, length)));
    this.take(header, new Float32Array(data, JSON_START + length));
  }

  send(content) {
    if (this.socket?.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify({ ...content, token: TOKEN }));
  }
}
