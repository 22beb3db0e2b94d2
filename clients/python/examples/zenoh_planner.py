"""A planner that asks over Zenoh where a vehicle will be: copy this and replace `candidates` and `best` by what the planner thinks of.

    python zenoh_planner.py --connect tcp/127.0.0.1:7447 --fleet default --vehicle truck-1 --seconds 10
    python zenoh_planner.py --connect tls/router:7447 --authority fleet-ca.pem --certificate mission-1.pem --key mission-1.key --vehicle truck-1

A session named like the vehicle has to be open and to have a measurement (zenoh_publisher.py sends some). The question is a `PredictRequest` to the queryable
`nesam/v1/<fleet>/<vehicle>/predict`, the answer a `PredictReply`, or an error reply with a `PredictError`. Over Zenoh a question has no deadline of its own but its
`budget_s`. A planner that must have an answer in each cycle also keeps what it drives on when there is none.
"""

import argparse
import json
import sys
import time

import numpy as np
import zenoh
from google.protobuf.message import DecodeError
from nesam.v1 import prediction_pb2

STEP_S = 0.1
CHANNELS = 12


class Refused(Exception):
    """The service does not answer a question: `code` of google.rpc.Code, `field` at fault ("" where none is)."""

    def __init__(self, code: int, field: str, message: str):
        super().__init__(message)
        self.code, self.field = code, field


class ZenohPlanner:
    """Asks for predictions of one vehicle."""

    def __init__(self, endpoint: str, fleet: str, vehicle: str, tls=None):
        """tls: files (authority, certificate, key) for an endpoint `tls/...`; the certificate's common name is nesam:planner:<name>."""
        config = zenoh.Config()
        if tls is not None:
            for name, file in zip(("root_ca_certificate", "connect_certificate", "connect_private_key"), tls):
                config.insert_json5(f"transport/link/tls/{name}", json.dumps(str(file)))
            config.insert_json5("transport/link/tls/enable_mtls", "true")
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", json.dumps([endpoint]))
        config.insert_json5("scouting/multicast/enabled", "false")
        self._session = zenoh.open(config)
        self._key = f"nesam/v1/{fleet}/{vehicle}/predict"

    def predict(self, controls: np.ndarray, budget_s: float, **fields) -> prediction_pb2.PredictReply:
        """Asks where candidates lead, with the history of the session. controls: (samples, horizon, 2), speed m/s and second command in the unit of the vehicle card,
        for steps of 0.1 s. budget_s: time for the answer, s. fields: others of `PredictRequest`, such as `start_stamp_ns` and `sent` to ask from now.

        Raises Refused, and TimeoutError where nobody answers in time.
        """
        controls = np.ascontiguousarray(controls, dtype="<f4")
        request = prediction_pb2.PredictRequest(
            samples=controls.shape[0],
            horizon=controls.shape[1],
            controls=controls.tobytes(),
            history_use=prediction_pb2.HISTORY_USE_MEASURED,
            budget_s=budget_s,
            **fields,
        )
        # Of several servers the one that has the session answers.
        replies = self._session.get(self._key, payload=request.SerializeToString(), target=zenoh.QueryTarget.ALL, timeout=budget_s + 0.1)
        error = None
        for reply in replies:
            if reply.ok is not None:
                return prediction_pb2.PredictReply.FromString(reply.ok.payload.to_bytes())
            error = error or refusal(reply.err.payload.to_bytes())
        raise error or TimeoutError(f"nobody answers on {self._key}; is the service there, and of this fleet?")

    def close(self) -> None:
        """Leaves the network."""
        self._session.close()


def refusal(payload: bytes) -> Exception:
    """What an error reply says: the service tells a PredictError, Zenoh itself a text, for example that nobody has answered in time."""
    try:
        error = prediction_pb2.PredictError.FromString(payload)
    except DecodeError:
        return TimeoutError(payload.decode(errors="replace"))
    return Refused(error.code, error.field, error.message)


def states_of(reply: prediction_pb2.PredictReply) -> np.ndarray:
    """(samples, steps, 12): x y z roll pitch yaw vx vy vz wx wy wz after each step."""
    return np.frombuffer(reply.states, dtype="<f4").reshape(reply.samples, reply.steps, CHANNELS)


def candidates(speed_m_s: float = 2.0, samples: int = 64, horizon: int = 30) -> np.ndarray:
    """(samples, horizon, 2): one speed, steered from right to left. Replace this."""
    controls = np.full((samples, horizon, 2), speed_m_s, dtype=np.float32)
    controls[:, :, 1] = np.linspace(-0.5, 0.5, samples)[:, None]
    return controls


def best(reply: prediction_pb2.PredictReply) -> int:
    """The candidate that gets furthest to the left among those with nothing against them. Replace this."""
    y = states_of(reply)[:, -1, 1].copy()
    # Bits of `Validity`: not finite, off the map, overturned.
    y[np.array(reply.validity) & (1 | 2 | 64) != 0] = -np.inf
    return int(np.argmax(y))


def plan(planner: ZenohPlanner, cycle_s: float, cycles: int) -> int:
    """Asks in each cycle and tells the best candidate; how many got an answer."""
    answered, controls, start = 0, candidates(), time.monotonic()
    for i in range(cycles):
        time.sleep(max(0.0, start + i * cycle_s - time.monotonic()))
        try:
            reply = planner.predict(controls, budget_s=cycle_s)
        except (Refused, TimeoutError) as error:
            print(f"no answer in cycle {i}: {error}", file=sys.stderr)
            continue
        answered, chosen = answered + 1, best(reply)
        x, y = states_of(reply)[chosen, -1, :2]
        print(f"second command {controls[chosen, 0, 1]:+.2f} leads to ({x:.2f}, {y:.2f}) m in {STEP_S * reply.steps:.1f} s", flush=True)
    return answered


def main() -> int:
    """Exit code: 0 every question was answered, 1 not, 2 wrong usage, 130 interrupted."""
    parser = argparse.ArgumentParser(description="Asks for predictions of a vehicle over Zenoh.")
    parser.add_argument("--connect", default="tcp/127.0.0.1:7447", help="endpoint of the router or server (%(default)s)")
    parser.add_argument("--fleet", default="default", help="as the server names it, zenoh.fleet (%(default)s)")
    parser.add_argument("--vehicle", default="truck-1", help="name of an open session (%(default)s)")
    parser.add_argument("--cycle", type=float, default=0.1, help="time between two questions and for each, s (%(default)s)")
    parser.add_argument("--seconds", type=float, default=10.0, help="how long to ask, s (%(default)s)")
    parser.add_argument("--authority", help="for tls/...: authority of the router's certificate, PEM")
    parser.add_argument("--certificate", help="this planner's certificate, common name nesam:planner:<name>")
    parser.add_argument("--key", help="its private key")
    arguments = parser.parse_args()
    tls = (arguments.authority, arguments.certificate, arguments.key)
    if any(tls) and not all(tls):
        parser.error("--authority, --certificate and --key go together")
    if arguments.cycle <= 0.0:
        parser.error("--cycle is above 0")
    try:
        planner = ZenohPlanner(arguments.connect, arguments.fleet, arguments.vehicle, tls if all(tls) else None)
    except zenoh.ZError as error:
        print(f"error: {arguments.connect}: {error}", file=sys.stderr)
        return 1
    cycles = max(1, round(arguments.seconds / arguments.cycle))
    try:
        return 0 if plan(planner, arguments.cycle, cycles) == cycles else 1
    except KeyboardInterrupt:
        return 130
    finally:
        planner.close()


if __name__ == "__main__":
    sys.exit(main())
