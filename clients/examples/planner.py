"""A small sampling planner (MPPI) on top of the service: drives to a goal on a hilly map.

The plant is the service's own prediction of the first step, so that the example needs nothing but a running server:

    nesam serve &
    python clients/examples/planner.py 127.0.0.1:50051
"""

import argparse
import sys

import numpy as np

import nesam

SAMPLES, HORIZON, DT_S = 256, 24, 0.1
GOAL = np.array([8.0, 5.0])
TEMPERATURE = 0.1
# Steps for which a drawn command is held: noise that changes with each step hardly bends the path of a slow vehicle.
HELD = 4


def hilly_map() -> nesam.WorldMap:
    """40 x 40 m of gentle hills."""
    y, x = np.mgrid[0:161, 0:161] * 0.25
    elevation = 0.3 * np.sin(x / 5) * np.cos(y / 6)
    rgb = np.full((161, 161, 3), (110, 150, 70), dtype=np.uint8)
    return nesam.WorldMap("planner-hills", elevation.astype(np.float32), 0.25, origin_m=(-20.0, -20.0), semantic_rgb=rgb)


def costs(prediction: nesam.Prediction) -> np.ndarray:
    """(samples,): distance to the goal over the horizon, tilt, and a fine for what the service warns of."""
    states = prediction.states
    distance = np.hypot(states[..., 0] - GOAL[0], states[..., 1] - GOAL[1])
    tilt = np.abs(states[..., 3]) + np.abs(states[..., 4])
    bad = prediction.validity & (nesam.Validity.NOT_FINITE | nesam.Validity.OFF_MAP | nesam.Validity.OVERTURNED) != 0
    return distance.mean(axis=1) + 2.0 * distance.min(axis=1) + tilt.mean(axis=1) + 1e3 * bad


def drive(client: nesam.Client) -> bool:
    """Plans in a session of its own until the goal is reached or 30 s are over; whether it is."""
    world = hilly_map()
    if world.map_id not in [m.map_id for m in client.maps()]:
        client.upload_map(world)
    session = client.open_session("planner-example", map_id=world.map_id)
    try:
        return plan(client, session)
    finally:
        client.close_session(session.session_id)


def plan(client: nesam.Client, session: nesam.Session) -> bool:
    """The loop of a planner: measure, draw candidates, predict, weigh, command."""
    random = np.random.default_rng(1)
    card = session.vehicle
    fallback = nesam.KinematicFallback(card)
    low = np.array([0.5, card.second_range[0]], dtype=np.float32)
    high = np.array([min(3.0, card.speed_range_m_s[1]), card.second_range[1]], dtype=np.float32)
    nominal = np.tile(np.float32([1.5, 0.0]), (HORIZON, 1))
    state = np.zeros(12)
    state[0:3], state[6] = (-6.0, -4.0, 0.6), 1.5
    with client.measurement_stream() as vehicle:
        for step in range(300):
            # The plant is the service: the next prediction begins at this measurement, so its answer is waited for. A vehicle hands an iterator to
            # `client.exchange` in a thread of its own, which waits for none.
            vehicle.send(nesam.Measurement(session.session_id, int(step * DT_S * 1e9), state, nominal[0].astype(float)))
            noise = random.normal(0.0, (0.4, 0.35), (SAMPLES, HORIZON // HELD, 2)).astype(np.float32).repeat(HELD, axis=1)
            controls = np.clip(nominal + noise, low, high)
            controls[0] = nominal
            prediction = client.predict(session.session_id, controls, fallback=fallback)
            cost = costs(prediction)
            weights = np.exp(-(cost - cost.min()) / TEMPERATURE)
            nominal = np.clip(np.einsum("n,nkc->kc", weights / weights.sum(), controls), low, high).astype(np.float32)
            plant = client.predict(session.session_id, nominal[None, :1])
            state = plant.states[0, 0].astype(float)
            remaining = float(np.hypot(*(state[:2] - GOAL)))
            if step % 10 == 0:
                print(f"t {step * DT_S:4.1f} s  at ({state[0]:6.2f}, {state[1]:6.2f}) m  goal {remaining:5.2f} m  {prediction.computed_by}")
            nominal = np.vstack([nominal[1:], nominal[-1:]])
            if remaining < 1.0:
                return True
    return False


def main() -> int:
    """Exit code: 0 the goal was reached, 1 it was not, 2 wrong usage, 130 interrupted."""
    arguments = argparse.ArgumentParser(description="A small sampling planner on top of the service: drives to a goal on a hilly map.")
    arguments.add_argument("address", nargs="?", default="127.0.0.1:50051", help="host:port of the server (%(default)s)")
    try:
        client = nesam.Client(arguments.parse_args().address, timeout_s=60.0)
    except ValueError as error:
        arguments.error(str(error))
    try:
        with client:
            reached = drive(client)
    except nesam.NesamError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    print("goal reached" if reached else "goal not reached")
    return 0 if reached else 1


if __name__ == "__main__":
    sys.exit(main())
