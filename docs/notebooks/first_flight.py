"""A first flight in Python: plan, fly, look at it, keep it."""

# %% [markdown]
# Plan a scenario, fly it without ROS, look at it. The flight is the one of
# `spacerobot run sliding_masses`, to the last bit.

# %%
from spacerobot_ros import fly, load_scenario, plan

schedule = plan(load_scenario("sliding_masses"))
print(f"{schedule.method}: {schedule.duration} s in {schedule.ticks} ticks")

# %%
flight = fly("sliding_masses")
flight  # noqa: B018

# %%
flight.plot()

# %% [markdown]
# All arrays are copies, for numpy; `to_pandas()` has them with names.

# %%
places = [f"pose.pose.position.{axis}" for axis in "xyz"]
flight.to_pandas()[[*places, "position[slider_1]"]].tail(3)

# %% [markdown]
# The same with noise of 2 mm, by another seed, and as an animation.

# %%
noisy = fly("sliding_masses", seed=7, parameters={"plant.sensors.position_noise": 0.002})
noisy.animate(frames=12, seconds=3.0)

# %% [markdown]
# A bag that `spacerobot verify` and `spacerobot report` take:

# %%
flight.save("out/first_flight.mcap", overwrite=True)
