// One drive whose CANopen is the package `canopen`. Lines come and go on stdin and stdout; see ../slcan_hub.py.
'use strict';

const readline = require('readline');

// Time goes on where the hub says so, and nowhere else.
const timers = new Set();
let now = 0;

function started(call, ms, again) {
    const timer = { call, ms, again, due: now + ms, refresh() { timer.due = now + ms; } };
    timers.add(timer);
    return timer;
}

globalThis.setInterval = (call, ms) => started(call, ms, true);
globalThis.setTimeout = (call, ms) => started(call, ms, false);
globalThis.clearInterval = globalThis.clearTimeout = (timer) => timers.delete(timer);

function pass(ms) {
    now += ms;
    for (const timer of [...timers]) {
        while (timers.has(timer) && timer.due <= now + 1e-6) {
            if (timer.again) timer.due += timer.ms;
            else timers.delete(timer);
            timer.call();
        }
    }
}

// Only block transfer needs its native module, and our host makes none.
const crc = require.resolve('node-crc');
require.cache[crc] = { id: crc, filename: crc, loaded: true, exports: { crc() { throw new Error('no block transfer'); } } };

const { Device, Eds, ObjectType } = require('canopen');

const say = (line) => process.stdout.write(line + '\n');
const hex = (number, digits) => number.toString(16).toUpperCase().padStart(digits, '0');

let device;
let shown = false; // a value that the hub shows is not told back to it

function told(entry) {
    if (!shown) say('=' + hex(entry.index, 4) + hex(entry.subIndex || 0, 2) + entry.raw.toString('hex'));
}

function described(object) {
    const data = { parameterName: object.name, dataType: object.type, accessType: object.access, pdoMapping: object.mappable };
    if (object.limits) [data.lowLimit, data.highLimit] = object.limits;
    return data;
}

function build({ node, objects }) {
    const eds = new Eds();
    for (const index of [0x1000, 0x1001, 0x1018]) eds.removeEntry(index);
    const several = new Set(objects.filter((object) => object.sub > 0).map((object) => object.index));
    for (const object of objects) {
        let entry = eds.getEntry(object.index);
        if (!several.has(object.index)) {
            entry = eds.addEntry(object.index, described(object));
        } else {
            entry = entry || eds.addEntry(object.index, { parameterName: object.name, objectType: ObjectType.RECORD });
            if (object.sub > 0) entry = eds.addSubEntry(object.index, object.sub, described(object));
            else entry = entry.at(0);
        }
        entry.raw = Buffer.from(object.bytes, 'hex');
    }
    // Sub-index 0 counts what there is, and grew while that was added.
    for (const object of objects) {
        if (object.sub === 0 && several.has(object.index))
            eds.getEntry(object.index).at(0).raw = Buffer.from(object.bytes, 'hex');
    }
    eds.addSdoServerParameter(node, 0x580 + node, 0x600 + node);
    device = new Device({ eds, id: node });
    device.on('message', ({ id, data }) => say('t' + hex(id, 3) + data.length + data.toString('hex').toUpperCase()));
    for (const index of new Set(objects.map((object) => object.index)))
        if (index >= 0x2000) eds.getEntry(index).on('update', told);
    device.pdo.on('pdo', (pdo) => pdo.dataObjects.forEach(told));
    device.start();
}

function show(line) {
    const entry = device.eds.getEntry(parseInt(line.slice(1, 5), 16));
    shown = true;
    (entry.subNumber ? entry.at(parseInt(line.slice(5, 7), 16)) : entry).raw = Buffer.from(line.slice(7), 'hex');
    shown = false;
}

function take(line) {
    let data = Buffer.from(line.slice(5), 'hex');
    // The package looks for the counter of a SYNC in its second byte; CiA 301 has it in the first.
    if (line.startsWith('t080')) data = Buffer.concat([data, data]);
    device.receive({ id: parseInt(line.slice(1, 4), 16), data, len: data.length });
}

readline.createInterface({ input: process.stdin }).on('line', (line) => {
    if (line[0] === '{') build(JSON.parse(line));
    else if (line[0] === '+') return pass(Number(line.slice(1)));
    else if (line[0] === '=') return show(line);
    else take(line);
    setImmediate(() => say('.')); // after what the package puts off
}).on('close', () => process.exit());
