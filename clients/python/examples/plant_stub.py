"""A plant for `nesam navigate --plant HOST:PORT`: the smallest simulator that speaks the protocol of docs/plant-adapter.md.

    python3 plant_stub.py 127.0.0.1:5599

Put your simulator where `Bicycle` is: `reset` sets the vehicle down at rest, `step` holds a command for 0.1 s, `state` gives
x y z roll pitch yaw (World, m and rad), velocity and angular velocity (Body, m/s and rad/s).
"""

import argparse
import json
import math
import socket
import sys


# Name, version, settings: laps on plants of one name are laps on one plant. Change it with whatever changes the motion.
NAME = "bicycle of the example, 1"
# From the rear axle, about which the car turns, ahead to the reference point, whose position and velocity are told, m.
REFERENCE_M = 1.7


class Bicycle:
    """A car on a level floor: the speed follows its command within half a second, the wheels do not slip."""

    def reset(self, world, seed, x_m, y_m, yaw_rad):
        self.pose, self.speed, self.rate = [x_m, y_m, yaw_rad], 0.0, 0.0

    def step(self, speed_m_s, second):
        for _ in range(10):
            self.speed += 0.01 / 0.5 * (speed_m_s - self.speed)
            self.rate = self.speed * math.tan(0.37 * second) / 3.3
            (x, y, yaw), vx, vy = self.pose, self.speed, REFERENCE_M * self.rate
            east, north = vx * math.cos(yaw) - vy * math.sin(yaw), vx * math.sin(yaw) + vy * math.cos(yaw)
            self.pose = [x + 0.01 * east, y + 0.01 * north, yaw + 0.01 * self.rate]

    def state(self):
        x, y, yaw = self.pose
        yaw = math.remainder(yaw, math.tau)
        return [x, y, 0.6, 0.0, 0.0, yaw, self.speed, REFERENCE_M * self.rate, 0.0, 0.0, 0.0, self.rate]


def answer(plant, request):
    if request["type"] == "reset":
        plant.reset(*(request[key] for key in ("world", "seed", "x_m", "y_m", "yaw_rad")))
        return {"plant": NAME, "state": plant.state()}
    if not hasattr(plant, "pose"):
        return {"error": "reset comes first"}
    plant.step(request["speed_m_s"], request["second"])
    return {"state": plant.state()}


def serve(plug):
    plant, last, client = Bicycle(), {}, None
    while True:
        request, sender = plug.recvfrom(2048)
        request = json.loads(request)
        number = request["id"]
        if sender == client and number < last["id"]:  # a late copy: it has been answered long ago
            continue
        if sender != client:  # somebody else begins with a reset
            plant = Bicycle()
        if sender != client or number > last["id"]:  # else asked again: answer again, move nothing
            last, client = {"nesam_plant": 1, "id": number, **answer(plant, request)}, sender
        plug.sendto(json.dumps(last).encode(), sender)


def main():
    arguments = argparse.ArgumentParser(description="The smallest plant for `nesam navigate --plant HOST:PORT`.")
    arguments.add_argument("address", nargs="?", default="127.0.0.1:5599", help="HOST:PORT to listen on (%(default)s)")
    address = arguments.parse_args().address
    host, _, port = address.rpartition(":")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as plug:
        try:
            plug.bind((host, int(port)))
        except (OSError, ValueError, OverflowError) as error:
            sys.exit(f"error: cannot listen on {address}: {error}")
        try:
            serve(plug)
        except KeyboardInterrupt:
            pass


if __name__ == "__main__":
    main()
