"""MJCF files of tests: arms, a floating quadruped, and trees with every kind of joint."""

from __future__ import annotations

# Hinges with range, reference, position and tilted axis; a slide; armature of joints and actuators; effort limits.
ARM = """
<mujoco model="arm">
  <compiler angle="radian"/>
  <default><default class="picture"><geom contype="0" conaffinity="0"/></default></default>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 .1"/>
    <body name="base" pos="0 0 .1">
      <geom type="cylinder" size=".06 .05" mass="3"/>
      <body name="upper" pos="0 0 .1" euler=".1 0 .2">
        <joint name="shoulder" axis="0 1 0" range="-2 2" armature=".2" pos=".01 .02 .03" ref=".4"/>
        <geom type="capsule" fromto="0 0 0 .3 0 0" size=".04" mass="2"/>
        <geom class="picture" type="box" size=".1 .1 .1" rgba="1 0 0 1" mass="0"/>
        <body name="fore" pos=".3 0 0">
          <joint name="elbow" axis="0 1 1" range="-2.5 2.5" armature=".1" actuatorfrcrange="-30 20" damping="1"/>
          <geom type="capsule" fromto="0 0 0 .25 0 0" size=".03" mass="1.5"/>
          <body name="hand" pos=".25 0 0">
            <joint name="wrist" axis="1 0 0" frictionloss=".1"/>
            <joint name="reach" type="slide" axis="1 0 0" range="0 .1" ref=".02" pos="0 .01 0"/>
            <geom type="ellipsoid" size=".05 .04 .03" mass=".4"/>
            <site name="tip" pos=".05 0 0" euler="0 1.5 0"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <contact><exclude body1="base" body2="fore"/></contact>
  <actuator>
    <motor name="m0" joint="shoulder" gear="5" ctrlrange="-10 12" armature=".01"/>
    <position name="m1" joint="elbow" kp="100" forcerange="-40 40" ctrlrange="-2 2"/>
    <position name="m2" joint="wrist" kp="10" ctrlrange="-1 1"/>
    <general name="m3" joint="reach" gainprm="50" forcerange="-8 9" gear="3"/>
  </actuator>
  <keyframe>
    <key name="home" qpos=".5 .6 .7 .03"/>
    <key qpos="1 1 1 .1"/>
  </keyframe>
</mujoco>
"""

_LEG = """
      <body name="thigh_{0}" pos="{1} {2} 0">
        <joint name="roll_{0}" axis="1 0 0" range="-40 40"/>
        <joint name="pitch_{0}" axis="0 1 0" range="-90 90" pos="0 .01 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.2" size=".025" mass=".8"/>
        <body name="shin_{0}" pos="0 0 -.2">
          <joint name="knee_{0}" axis="0 -1 0" range="-10 120" ref="30"/>
          <geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02" mass=".3"/>
          <geom type="sphere" size=".025" pos="0 0 -.2" mass=".05"/>
          <site name="foot_{0}" pos="0 0 -.225"/>
        </body>
      </body>"""

# A floating base with four legs, whose hips have two joints in one body.  The file has a keyframe, and angles in
# degrees.
QUADRUPED = f"""
<mujoco model="quadruped">
  <default><joint armature=".01" damping=".2"/><motor ctrlrange="-20 20"/></default>
  <worldbody>
    <geom type="plane" size="3 3 .1"/>
    <body name="trunk" pos="0 0 .45" euler="0 0 30">
      <freejoint name="world_joint"/>
      <geom type="box" size=".25 .1 .05" mass="6"/>
      {_LEG.format("fl", 0.2, 0.1)}{_LEG.format("fr", 0.2, -0.1)}
      {_LEG.format("hl", -0.2, 0.1)}{_LEG.format("hr", -0.2, -0.1)}
    </body>
  </worldbody>
  <actuator>
    {"".join(f'<motor joint="{j}_{n}"/>' for n in ("fl", "fr", "hl", "hr") for j in ("roll", "pitch", "knee"))}
  </actuator>
  <keyframe>
    <key name="stand" qpos="0 0 .4 1 0 0 0 {"0 .5 .9 " * 4}"/>
  </keyframe>
</mujoco>
"""

# Two trees on the world, with ball joints, and with unlimited hinges along negative and tilted axes with a reference.
# Some bodies have no name, several joints at different points, or no joint.
ODD = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <geom type="box" size=".1 .1 .1" pos="0 0 -.2"/>
    <body pos="0 .5 0">
      <joint type="ball" range="0 1" pos="0 0 .02" armature=".03"/>
      <geom type="box" size=".1 .05 .05" pos=".1 0 0" mass="2"/>
      <body pos=".2 0 0" quat=".9 .1 .2 .3">
        <joint axis="0 0 -1" ref="1.1" armature=".02"/>
        <geom type="sphere" size=".06" pos="0 0 .1" mass="1"/>
        <body pos="0 0 .1"><geom type="sphere" size=".04" pos=".1 0 0" mass=".4"/></body>
      </body>
    </body>
    <body name="second" pos="0 -.5 0">
      <joint name="a" axis="1 2 3" ref=".3" pos=".1 0 0"/>
      <joint name="b" type="slide" axis="0 -1 .5" ref="-.2"/>
      <joint name="c" axis="1 0 0" pos="0 .2 0" range="-1 1"/>
      <geom type="box" size=".1 .2 .05" mass="1.2"/>
      <site name="second" pos=".1 0 0"/>
    </body>
  </worldbody>
</mujoco>
"""

# A triangular prism as inline mesh, which is solid on one link and visual on the other.
MESH = """
<mujoco>
  <asset>
    <mesh name="wedge" scale=".1 .1 .1" vertex="0 0 0  2 0 0  0 1 0  0 0 1  2 0 1  0 1 1  .5 .2 .5"
          face="0 2 1  3 4 6  4 5 6  5 3 6  0 1 4  0 4 3  1 2 5  1 5 4  2 0 3  2 3 5"/>
  </asset>
  <worldbody>
    <body name="first">
      <joint name="one" axis="0 0 1" range="-90 90"/>
      <geom type="mesh" mesh="wedge" mass="1" rgba=".2 .4 .6 1"/>
      <geom type="sphere" size=".3" contype="0" conaffinity="0" mass="0"/>
      <body name="second" pos=".4 0 0">
        <joint name="two" axis="0 1 0" range="-90 90"/>
        <inertial pos="0 0 0" mass="1" diaginertia=".01 .01 .01"/>
        <geom type="mesh" mesh="wedge" contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""

ALL = {"arm": ARM, "quadruped": QUADRUPED, "odd": ODD, "mesh": MESH}
