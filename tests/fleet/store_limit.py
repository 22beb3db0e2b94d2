"""tests/fleet/run --store-limit: how many vehicles one etcd bears. An input of docs/capacity.md.

Servers write each session once a second, on condition that its owner is who it was, as `server/src/store/etcd.rs` does: what is due together goes into one
transaction. Here nothing but that happens: writers send the same transactions for more and more vehicles, until a write that is due waits for longer than a second, or etcd is full."""

import threading
import time

import grpc

from scaling import processor_s

SESSION_BYTES = 26_400
"""As `--scaling` measures it."""
WRITERS = 3
GROUP = 32
"""Sessions of one transaction."""
SECONDS = 65.0
"""Of each load: the first compaction that lets something go comes after 60 s."""
COMPACT_EVERY_S = 30.0
LOADS = (250, 500, 1000, 2000, 4000)
LATE_S = 1.0


def _varint(value):
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def _field(number, content):
    """A field of bytes, or of a whole number, in the encoding of protobuf."""
    if isinstance(content, int):
        return _varint(number << 3) + _varint(content)
    return _varint(number << 3 | 2) + _varint(len(content)) + content


def _put(key, value):
    return _field(1, key) + _field(2, value)


def _transaction(writes):
    """A TxnRequest of etcdserverpb: each (owner, revision at which it was made, key, value) is put where all owners are those."""
    conditions = b"".join(_field(1, _field(2, 1) + _field(3, owner) + _field(5, revision)) for owner, revision, _, _ in writes)
    return conditions + b"".join(_field(2, _field(2, _put(key, value))) for _, _, key, value in writes)


def _number(message, *path):
    """A whole number in a message, by the fields that lead to it; 0 where it is not there."""
    wanted, *rest = path
    at = 0
    while at < len(message):
        tag, at = _read_varint(message, at)
        value, at = _read_varint(message, at)
        if tag & 7 == 2:
            value, at = message[at : at + value], at + value
        if tag >> 3 == wanted:
            return _number(value, *rest) if rest else value
    return 0


def _read_varint(message, at):
    value = shift = 0
    while True:
        byte, at = message[at], at + 1
        value |= (byte & 0x7F) << shift
        shift += 7
        if byte < 0x80:
            return value, at


class Store:
    """A connection to etcd."""

    def __init__(self, address):
        self._channel = grpc.insecure_channel(address, options=[("grpc.max_receive_message_length", -1)])
        self._calls = {}

    def call(self, method, request):
        if method not in self._calls:
            self._calls[method] = self._channel.unary_unary(f"/etcdserverpb.{method}")
        return self._calls[method](request, timeout=30.0)

    def put(self, key, value):
        """The revision at which it is written."""
        return _number(self.call("KV/Put", _put(key, value)), 1, 3)

    def status(self):
        """Bytes that the database takes on the disk, and those of them in use."""
        told = self.call("Maintenance/Status", b"")
        return _number(told, 3), _number(told, 9)


class Writer(threading.Thread):
    """One server: writes its sessions, each once a second."""

    def __init__(self, address, sessions, content):
        super().__init__()
        self._store, self._sessions, self._content = Store(address), sessions, content
        self.waits_s, self.refused, self.ended = [], 0, ""

    def run(self):
        try:
            self._write()
        except grpc.RpcError as error:
            self.ended = error.details()

    def _write(self):
        owners = [(f"limit/owner/{name}".encode(), name) for name in self._sessions]
        revisions = [self._store.put(owner, b"writer") for owner, _ in owners]
        begun = time.monotonic()
        # Due one after the other, evenly over each second.
        due = [begun + 1.0 + i / len(owners) for i in range(len(owners))]
        while (now := time.monotonic()) < begun + SECONDS:
            ready = sorted((i for i in range(len(owners)) if due[i] <= now), key=due.__getitem__)[:GROUP]
            if not ready:
                time.sleep(min(0.005, max(0.0, min(due) - now)))
                continue
            writes = [(owners[i][0], revisions[i], f"limit/session/{owners[i][1]}".encode(), self._content) for i in ready]
            held = _number(self._store.call("KV/Txn", _transaction(writes)), 2)
            done = time.monotonic()
            self.refused += not held
            for i in ready:
                self.waits_s.append(done - due[i])
                # As a server: the next second begins when it is written.
                due[i] = max(due[i] + 1.0, done)


def measure(fleet):
    """Prints the table."""
    address = f"{fleet.hosts.address['etcd']}:2379"
    store, process = Store(address), fleet.processes["etcd"]
    print(f"{SESSION_BYTES} bytes for each vehicle and second, {WRITERS} writers, {SECONDS:.0f} s each, compaction every {COMPACT_EVERY_S:.0f} s")
    print(f"{'vehicles':>8} {'writes/s':>9} {'MB/s':>6} {'p50 ms':>8} {'p99 ms':>8} {'etcd ms a vehicle s':>20} {'database MB':>12} {'in use MB':>10}")
    for vehicles in LOADS:
        content = bytes(i * 7919 % 251 for i in range(SESSION_BYTES))
        writers = [Writer(address, [f"{vehicles}-{i}" for i in range(k, vehicles, WRITERS)], content) for k in range(WRITERS)]
        before, begun, revision = processor_s(process), time.monotonic(), 0
        for writer in writers:
            writer.start()
        while any(writer.is_alive() for writer in writers):
            writers[0].join(COMPACT_EVERY_S)
            # Up to where it was at the last compaction, as servers do.
            try:
                now = store.put(b"limit/compacted", b"")
                if revision:
                    store.call("KV/Compact", _field(1, revision))
                revision = now
            except grpc.RpcError as error:
                print(f"{vehicles:>8} not compacted: {error.details()}", flush=True)
        for writer in writers:
            writer.join()
        took_s = time.monotonic() - begun
        waits = sorted(wait for writer in writers for wait in writer.waits_s)
        ended = next((writer.ended for writer in writers if writer.ended), "")
        if ended or not waits:
            print(f"{vehicles:>8} ended after {took_s:.0f} s: {ended}", flush=True)
            break
        refused = sum(writer.refused for writer in writers)
        total, used = store.status()
        p99 = waits[int(0.99 * len(waits))]
        print(
            f"{vehicles:>8} {len(waits) / took_s:>9.0f} {len(waits) / took_s * SESSION_BYTES / 1e6:>6.1f} {1e3 * waits[len(waits) // 2]:>8.1f} {1e3 * p99:>8.1f}"
            f" {1e3 * (processor_s(process) - before) / len(waits):>20.2f} {total / 1e6:>12.0f} {used / 1e6:>10.0f}" + (f"  {refused} refused" if refused else ""),
            flush=True,
        )
        if p99 > LATE_S:
            break
