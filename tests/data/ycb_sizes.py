"""The sizes of the YCB objects, as FAT's object settings have them."""

# FAT's cuboid_dimensions [m], along the axes of FAT's aligned frame.
YCB_SIZES = {
    "002_master_chef_can": (0.10240, 0.14018, 0.10231),
    "003_cracker_box": (0.16404, 0.21344, 0.07180),
    "004_sugar_box": (0.09268, 0.17625, 0.04513),
    "005_tomato_soup_can": (0.06766, 0.10186, 0.06771),
    "006_mustard_bottle": (0.09602, 0.19130, 0.05825),
    "007_tuna_fish_can": (0.08556, 0.03354, 0.08554),
    "008_pudding_box": (0.11365, 0.08982, 0.03847),
    "009_gelatin_box": (0.08918, 0.07312, 0.02998),
    "010_potted_meat_can": (0.10165, 0.08354, 0.05760),
    "011_banana": (0.19717, 0.03865, 0.07407),
    "019_pitcher_base": (0.18862, 0.24239, 0.13311),
    "021_bleach_cleanser": (0.10243, 0.25058, 0.06770),
    "024_bowl": (0.16116, 0.05501, 0.16146),
    "025_mug": (0.11699, 0.08130, 0.09309),
    "035_power_drill": (0.18436, 0.18684, 0.05719),
    "036_wood_block": (0.08970, 0.20609, 0.09078),
    "037_scissors": (0.20260, 0.08753, 0.01566),
    "040_large_marker": (0.01883, 0.12089, 0.01948),
    "051_large_clamp": (0.16494, 0.12167, 0.03641),
    "052_extra_large_clamp": (0.20260, 0.16520, 0.03648),
    "061_foam_brick": (0.07787, 0.05119, 0.05256),
}
