// A sender over MQTT of another library, with JSON messages; tests/support/reliability/plc.py starts and kills it.
//
//     node tests/support/mqtt_sender/sender.js SETTINGS
"use strict";
const fs = require("node:fs");
const mqtt = require("mqtt");

function message(settings, number) {
  const [t, r, u, y] = settings.blocks[number % settings.blocks.length];
  const start = settings.first + Math.floor(number / settings.blocks.length) * settings.round_s;
  return JSON.stringify({ version: 1, stream: 0, sequence: number, t: t.map((x) => start + x), r, u, y });
}

function main(settings) {
  const client = mqtt.connect({ host: "127.0.0.1", port: settings.port, keepalive: 5, reconnectPeriod: 500 });
  const notes = fs.openSync(settings.written, "a");
  let number = Math.floor((Date.now() / 1000 - settings.began) / settings.every_s);
  function next() {
    number += 1;
    setTimeout(send, Math.max(0, 1000 * (settings.began + number * settings.every_s) - Date.now()));
  }
  function send() {
    for (const [name, topic] of Object.entries(settings.nodes)) {
      fs.writeSync(notes, `${name} ${number}\n`);
      client.publish(topic, message(settings, number), { qos: 1 });
    }
    next();
  }
  client.on("error", (error) => console.error(error.message));
  client.once("connect", () => {
    console.log("ready");
    next();
  });
}

main(JSON.parse(fs.readFileSync(process.argv[2], "utf-8")));
