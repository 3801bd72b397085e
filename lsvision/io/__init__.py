"""Files: rig, scan, calibration and product; read by line ranges, checked on reading, complete under a final name."""

from lsvision.io.atomic import naming_full_disk, remove_partial_siblings, write_text
from lsvision.io.formats.calibration import read_calibration, write_calibration
from lsvision.io.formats.candidates import write_candidates, write_wear
from lsvision.io.formats.checksum import scan_sha256
from lsvision.io.formats.encoder import read_encoder, write_encoder
from lsvision.io.formats.line_motion import read_line_motion, write_line_motion
from lsvision.io.formats.raw_rig import (
    RigPair,
    raw_rig_from_dict,
    raw_rig_to_dict,
    read_raw_rig,
    read_rig_pair,
    write_raw_rig,
)
from lsvision.io.formats.response import copy_response, read_response, write_response, write_rig_with_response
from lsvision.io.formats.rig import read_rig, rig_from_dict, rig_to_dict, write_rig
from lsvision.io.formats.rig_calibration import write_rig_calibration
from lsvision.io.formats.rig_match import check_rig_match, rig_difference
from lsvision.io.formats.scan import NewScan, read_scan, write_scan
from lsvision.io.formats.scan_files import rig_file, scan_files
from lsvision.io.formats.section import read_section
from lsvision.io.images.line_image import open_line_image
from lsvision.io.images.tiff import write_line_image
from lsvision.io.json_file import finite_or_null, write_json
from lsvision.io.parquet import write_parquet
from lsvision.io.product.check import ProductCheck, check_product
from lsvision.io.product.export import ExportFormat, export_product
from lsvision.io.product.las import write_laz
from lsvision.io.product.layout import ProductLayout
from lsvision.io.product.measured import MeasuredCells
from lsvision.io.product.ply import write_ply
from lsvision.io.product.reader import Product, ProductImage, read_product
from lsvision.io.product.surface import (
    Surface,
    SurfaceRows,
    read_surface,
    surface_metadata,
    surface_writer,
    write_no_surface,
)
from lsvision.io.product.writer import ProductRows, complete_product, create_product, product_writer

__all__ = [
    "ExportFormat",
    "MeasuredCells",
    "NewScan",
    "Product",
    "ProductCheck",
    "ProductImage",
    "ProductLayout",
    "ProductRows",
    "RigPair",
    "Surface",
    "SurfaceRows",
    "check_product",
    "check_rig_match",
    "complete_product",
    "copy_response",
    "create_product",
    "export_product",
    "finite_or_null",
    "naming_full_disk",
    "open_line_image",
    "product_writer",
    "raw_rig_from_dict",
    "raw_rig_to_dict",
    "read_calibration",
    "read_encoder",
    "read_line_motion",
    "read_product",
    "read_raw_rig",
    "read_response",
    "read_rig",
    "read_rig_pair",
    "read_scan",
    "read_section",
    "read_surface",
    "remove_partial_siblings",
    "rig_difference",
    "rig_file",
    "rig_from_dict",
    "rig_to_dict",
    "scan_files",
    "scan_sha256",
    "surface_metadata",
    "surface_writer",
    "write_calibration",
    "write_candidates",
    "write_encoder",
    "write_json",
    "write_laz",
    "write_line_image",
    "write_line_motion",
    "write_no_surface",
    "write_parquet",
    "write_ply",
    "write_raw_rig",
    "write_response",
    "write_rig",
    "write_rig_calibration",
    "write_rig_with_response",
    "write_scan",
    "write_text",
    "write_wear",
]
