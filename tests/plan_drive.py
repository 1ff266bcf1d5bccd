"""A robot in plans that it sees without error, driven by an explorer."""

import math

import numpy as np

from echogrid import Grid, Robot
from echogrid.geometry import wrap
from echogrid.planning.explorer import Explorer

CELL, REACH_M, STEP_S = 0.05, 2.0, 0.16
DIM_M, LIKELY = 0.25, -0.8
"""How near a robot has to be to what is dim; the log-odds of what is likely free."""
B21 = Robot.load("b21")
WIDE, FAR = 160, 100
"""Cells of a plan: 8 x 5 m."""


def shut():
    """A plan of 8 x 5 m with walls all round; True is solid."""
    solid = np.zeros((FAR, WIDE), bool)
    solid[:2] = solid[-2:] = True
    solid[:, :2] = solid[:, -2:] = True
    return solid


def two_rooms(door=1.0):
    solid = shut()
    half = round(door / CELL / 2)
    solid[:, 79:81] = True
    solid[50 - half : 50 + half, 79:81] = False
    return solid


class Drive:
    """A robot whose sonars see each cell in plain sight within REACH_M, as it is, but for those that are dark.

    Of those that are dim it sees from farther off than DIM_M no more than that they are likely free.
    """

    def __init__(self, solid, pose=(1.0, 1.0, 0.0), dark=None, dim=None, turns=True):
        self.solid, self.dark = solid, np.zeros_like(solid) if dark is None else dark
        self.dim = np.zeros_like(solid) if dim is None else dim
        self.pose, self.explorer, self.time = np.array(pose), Explorer(B21, turns=turns), 0.0
        self.grid = Grid(np.zeros(solid.shape, np.float32), np.zeros(solid.shape, bool), CELL, (0.0, 0.0))
        self.way, self.least, self.goals = 0.0, math.inf, []
        self._middles = self.grid.centre_of(np.argwhere(solid))

    def look(self):
        bearing = np.arange(240) * (2 * np.pi / 240)
        r = np.arange(0.0, REACH_M, CELL / 2)
        points = self.pose[:2] + r[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], 1)[:, None]
        row, col = np.moveaxis(np.clip(self.grid.index_of(points), 0, np.array(self.solid.shape) - 1), -1, 0)
        solid = self.solid[row, col]
        before = np.cumsum(solid, axis=1) - solid == 0
        for cells, value in ((before & ~solid, -4.0), (before & solid, 6.0)):
            at = row[cells], col[cells]
            fine = ~self.dark[at]
            at = at[0][fine], at[1][fine]
            far = np.broadcast_to(r, solid.shape)[cells][fine] > DIM_M
            told = np.where(self.dim[at] & far & (value < 0), LIKELY, value)
            self.grid.log_odds[at] = np.where(self.grid.log_odds[at] == -4.0, np.minimum(told, value), told)
            self.grid.observed[at] = True

    def run(self, most_s=500.0):
        while self.explorer.state != "done":
            assert self.time < most_s, "never said that it was done"
            self.look()
            if self.explorer.due(self.time):
                self.explorer.think(self.grid, self.pose, self.time)
                if self.explorer.goal is not None:
                    self.goals.append(self.explorer.goal.place)
            speed, turn = self.explorer.drive(self.grid, self.pose)
            x, y, theta = self.pose
            middle = theta + turn * STEP_S / 2
            there = np.array([x + speed * STEP_S * math.cos(middle), y + speed * STEP_S * math.sin(middle)])
            self.way += math.dist(there, (x, y))
            self.pose = np.array([*there, float(wrap(theta + turn * STEP_S))])
            gap = np.min(np.linalg.norm(self._middles - there, axis=1)) - CELL / 2
            self.least = min(self.least, gap - B21.footprint_radius_m)
            self.time += STEP_S
        return self

    def seen(self):
        return float(np.mean(self.grid.observed[~self.solid]))
