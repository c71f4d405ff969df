"""OpenCV's non-local means, median and Gaussian blur of one picture, for a comparison of the bytes."""

import sys

import cv2

source, folder = sys.argv[1:]
frame = cv2.imread(source)
print(cv2.__version__)
cv2.imwrite(f"{folder}/nlm.png", cv2.fastNlMeansDenoisingColored(frame, None, 10, 10, 7, 21))
cv2.imwrite(f"{folder}/median.png", cv2.medianBlur(frame, 5))
cv2.imwrite(f"{folder}/gaussian.png", cv2.GaussianBlur(frame, (13, 13), 2, borderType=cv2.BORDER_REFLECT_101))
cv2.imwrite(f"{folder}/grey.png", cv2.fastNlMeansDenoising(frame[:, :, 1], None, 10, 7, 21))
