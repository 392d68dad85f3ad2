// The alarm list of an operator's station, by a stack that is not Python's: what it shows is what the events leave in it.
//
//     node tests/support/opcua_server/alarm_list.js URL
//
// Each line of its input is a command in JSON, {"do": "list" | "acknowledge" | "confirm" | "shelve" | "unshelve" | "refresh" | "health", ...};
// it answers with one line that begins with >. It connects again by itself, and asks for a refresh then, as Part 9 demands of it.
"use strict";
const readline = require("node:readline");
const opcua = require("node-opcua");

const plain = (field) => {
  const value = field?.value;
  if (Buffer.isBuffer(value)) return value.toString("hex");
  if (value instanceof Date) return value.getTime() / 1000;
  return value?.text ?? (value instanceof opcua.NodeId || value instanceof opcua.StatusCode ? value.toString() : value);
};

function shown(alarm) {
  const keys = ["sourceName", "conditionName", "eventType", "eventId", "message", "severity", "time", "retain", "comment", "clientUserId", "suppressedOrShelved"];
  const states = ["activeState", "ackedState", "confirmedState", "latchedState", "suppressedState", "outOfServiceState"];
  const fields = alarm.fields;
  return Object.fromEntries([
    ["condition", alarm.conditionId.toString()],
    ...keys.map((key) => [key, plain(fields[key])]),
    ...states.map((key) => [key, plain(fields[key]?.id)]),
    ["shelvingState", plain(fields.shelvingState?.currentState)],
  ]);
}

async function main(url) {
  const client = opcua.OPCUAClient.create({ endpointMustExist: false, connectionStrategy: { maxRetry: -1, initialDelay: 100, maxDelay: 300 }, keepSessionAlive: true, requestedSessionTimeout: 20000 });
  await client.connect(url);
  const session = await client.createSession();
  const alarms = await opcua.installAlarmMonitoring(session);
  const counts = { raised: 0, changed: 0, refreshed: 0, connected: 1 };
  alarms.on("newAlarm", () => (counts.raised += 1));
  alarms.on("alarmChanged", () => (counts.changed += 1));
  const refresh = async () => {
    counts.refreshed += 1;
    return await opcua.callConditionRefresh(session, session.$subscriptionForAlarmList.subscriptionId);
  };
  session.on("session_restored", () => (counts.connected += 1, refresh().catch(() => 0)));
  const call = (objectId, methodId, inputArguments) => session.call({ objectId, methodId, inputArguments }).then((result) => result.statusCode);
  const commands = {
    list: async () => alarms.alarms().filter((alarm) => alarm.getRetain()).map(shown),
    counts: async () => counts,
    refresh,
    acknowledge: (words) => session.acknowledgeCondition(words.condition, Buffer.from(words.eventId, "hex"), words.comment),
    confirm: (words) => session.confirmCondition(words.condition, Buffer.from(words.eventId, "hex"), words.comment),
    shelve: (words) => call(words.condition, "i=2949", [{ dataType: "Double", value: 1000 * words.for_s }]),
    unshelve: (words) => call(words.condition, "i=2947", []),
    health: async (words) => {
      const path = await session.translateBrowsePath(opcua.makeBrowsePath(words.asset, `/${words.di}:DeviceHealth`));
      const node = path.targets[0].targetId;
      const [value, kind] = await session.read([{ nodeId: node, attributeId: opcua.AttributeIds.Value }, { nodeId: node, attributeId: opcua.AttributeIds.DataType }]);
      const names = await session.read({ nodeId: "ns=3;i=6450", attributeId: opcua.AttributeIds.Value });
      return { value: value.value.value, type: kind.value.value.toString(), name: names.value.value[value.value.value].text };
    },
  };
  for await (const line of readline.createInterface({ input: process.stdin })) {
    const words = JSON.parse(line);
    const answer = await commands[words.do](words).catch((error) => `error: ${error.message}`);
    console.log("> " + JSON.stringify(answer instanceof opcua.StatusCode ? answer.name : (answer ?? null)));
  }
  process.exit(0);
}

main(process.argv[2]).catch((error) => (console.error(error), process.exit(1)));
