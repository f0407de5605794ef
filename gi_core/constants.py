"""Numbers that more than one file must agree on. The contract's are marked (contract): changing one breaks clients."""

SECTOR_SIZE_M = 64.0  # (contract) edge of a sector column; slide "Sector layout"
VOXEL_SIZE_M = 3.125  # (contract) 100 m / 32; slide "Irradiance volume"
FINE_VOXEL_SIZE_M = VOXEL_SIZE_M / 2  # (contract) of cascade -1
VOLUME_SHAPE = (16, 32, 32)  # (contract) y, z, x
MAX_CASCADE = 3  # (contract) 800 m wide: some 190 sectors
MAX_PROBES_PER_SECTOR = 1000  # (contract) slide "Sector layout"
SKY_SHAPE = (64, 128)  # (contract) rows (polar angle from +Y), columns (from +X towards +Z)

SURFEL_CELL_M = 1.0  # slide "Surfel grid"
BRICK_CELL_M = 4.0  # slide "Surfel grid"
MAX_BRICK_LEVEL = 7  # cells double at most this often: bricks of 512 m

# No surface outdoors reflects more than fresh snow does, and the feedback loop must contract: each bounce loses at least 5 %.
ALBEDO_MAX = 0.95

# Albedo of fresh snow (Warren, "Optical properties of snow", Rev. Geophys. 1982: 0.8 to 0.9 in visible light).
SNOW_ALBEDO = 0.85

# Voxel classes of ``mask=1`` (contract).
VOXEL_SOLID, VOXEL_OUTDOORS, VOXEL_INDOORS, VOXEL_NO_SECTOR = range(4)

# Room 0 is outdoors; authored rooms count from 1 in the order of world.toml, then come those that were found.
ROOM_OUTDOORS = 0
ROOM_CELL_M = VOXEL_SIZE_M / 8  # of the shape of a found room: two across the narrowest door
# Indoor and outdoor light mix where an opening fills more than this share of half the view; in textures of weights as seen from so much
# nearer (contract).
OPENING_LEAST_VIEW, OPENING_DEPTH_M = 0.25, VOXEL_SIZE_M / 8

# Coefficients per channel of each directional basis (contract): the ambient cube, and spherical harmonics of order 1 and 2.
BASIS_SIZES = {"cube": 6, "sh1": 4, "sh2": 9}
MAX_SKY_PATCHES = 1024  # Tregenza's dome has 145, Reinhart's finer one 577

# The directions whose irradiance an ambient cube stores (contract): +X -X +Y -Y +Z -Z.
CUBE_FACES = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))
